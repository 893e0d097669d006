"""Beetle antennae searches: each printed equation by hand, and what any search promises."""

from copy import deepcopy
from math import hypot, pi, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.beetle_antennae import SEARCHES, BeetleAntennaeSearch, Found, Objective
from estimators.messages import FloatArray

ALL = list(SEARCHES)
CORRECTED = ["bas", "ibas"]

places = st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def valley(optimum: FloatArray | float = 0.0) -> Objective:
    """A smooth bowl, steeper along later axes, without any symmetry between antennae."""

    def cost(points: FloatArray) -> FloatArray:
        weights = np.arange(1, points.shape[1] + 1)
        return np.asarray(((points - optimum) ** 2 * weights).sum(axis=1))

    return cost


def ripples(points: FloatArray) -> FloatArray:
    """Many local minima."""
    return np.asarray((points**2 - 10.0 * np.cos(2.0 * np.pi * points)).sum(axis=1))


def swarm(seed: int, beetles: int = 12, dimensions: int = 3) -> FloatArray:
    return np.random.default_rng(seed).uniform(-4.0, 4.0, (beetles, dimensions))


def run(name: str, objective: Objective, start: FloatArray, iterations: int, seed: int = 1) -> Found:
    return SEARCHES[name]().search(objective, start, iterations, np.random.default_rng(seed))


def plane(x: float, y: float) -> float:
    """Cost of `valley([1.5, -0.5])` at a point of the plane."""
    return (x - 1.5) ** 2 + 2.0 * (y + 0.5) ** 2


class Plane:
    """`plane` as an objective that remembers where it was asked."""

    def __init__(self) -> None:
        self.asked: list[FloatArray] = []

    def __call__(self, points: FloatArray) -> FloatArray:
        self.asked.append(points)
        return valley(np.array([1.5, -0.5]))(points)

    def was_asked(self, expected: list[list[list[float]]]) -> None:
        for asked, wanted in zip(self.asked, expected, strict=True):
            np.testing.assert_allclose(asked, wanted, rtol=1e-9)


START = np.array([[3.0, 1.0], [-2.0, 2.5], [0.5, -3.0]])


def sign(value: float) -> float:
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0


def test_printed_bas_follows_the_print() -> None:
    objective = Plane()
    run("bas_printed", objective, START, 2, seed=5)
    rng = np.random.default_rng(5)
    beetles, step, distance = START.tolist(), 5.0, 1.0
    expected = [START.tolist()]
    for _ in range(2):
        drawn = rng.random((3, 2)).tolist()
        differences = []
        for beetle, (a, b) in zip(beetles, drawn, strict=True):
            bx, by = a / hypot(a, b), b / hypot(a, b)
            # x_R - x_L of Eq. (12) is one point, d b behind the origin; all fitness is negative here.
            differences.append([-distance * bx, -distance * by])
            side = sign(-plane(*differences[-1]))
            beetle[0] += step * bx * side
            beetle[1] += step * by * side
        step, distance = 0.95 * step, 0.95 * distance + 0.01
        expected += [differences, deepcopy(beetles)]
    objective.was_asked(expected)


def test_bas_steps_to_the_better_side() -> None:
    found = run("bas", Plane(), START, 3, seed=6)
    rng = np.random.default_rng(6)
    beetles = START.tolist()
    for k in range(3):
        # Over 3 iterations the step loses what Eq. (14) takes in 200.
        step = 5.0 * 0.95 ** (200.0 * k / 3.0)
        half = step / 5.0 / 2.0
        for beetle, (a, b) in zip(beetles, rng.uniform(-1.0, 1.0, (3, 2)).tolist(), strict=True):
            bx, by = a / hypot(a, b), b / hypot(a, b)
            right = plane(beetle[0] - half * bx, beetle[1] - half * by)
            left = plane(beetle[0] + half * bx, beetle[1] + half * by)
            beetle[0] += step * bx * sign(right - left)
            beetle[1] += step * by * sign(right - left)
    np.testing.assert_allclose(found.beetles, beetles, rtol=1e-9)


@pytest.mark.parametrize("name", ["ibas_printed", "ibas_prose"])
def test_printed_ibas_follows_the_print(name: str) -> None:
    iterations = 3
    objective = Plane()
    found = run(name, objective, START, iterations, seed=7)
    expected = [START.tolist()]
    rng = np.random.default_rng(7)
    first = rng.random((3, 2))
    velocity = (first / np.linalg.norm(first, axis=1, keepdims=True)).tolist()  # (8)
    x = START.tolist()
    own = START.tolist()
    own_cost = [plane(*point) for point in own]
    step, d = 5.0, 1.0
    for k in range(iterations):
        w = 1.0 - 0.7 * k / iterations  # (18)
        before = step if name == "ibas_printed" else 5.0
        step = before * (0.95 / 0.35) ** (1.0 / (1.0 + 5.0 * k / iterations) - 1.0)  # (19), (20)
        r = rng.random((2, 3, 1))
        swarm_best = list(own[own_cost.index(min(own_cost))])
        costs, rights, lefts = [], [], []
        for i in range(3):
            to_own = [own[i][j] - x[i][j] for j in range(2)]
            to_best = [swarm_best[j] - x[i][j] for j in range(2)]
            for j in range(2):  # (21)
                velocity[i][j] = (
                    w * velocity[i][j]
                    + 2.0 * r[0, i, 0] * to_own[j] / (hypot(*to_own) or 1.0)
                    + 2.0 * r[1, i, 0] * to_best[j] / (hypot(*to_best) or 1.0)
                )
            rights.append([x[i][j] + velocity[i][j] * d / 2.0 for j in range(2)])  # (22)
            lefts.append([x[i][j] - velocity[i][j] * d / 2.0 for j in range(2)])  # (23)
            # (24), with fitness the negative of the cost
            side = sign(plane(*lefts[i]) - plane(*rights[i]))
            x[i] = [x[i][j] + step * velocity[i][j] * side for j in range(2)]
            costs.append(plane(*x[i]))
            if costs[i] < own_cost[i]:
                own[i], own_cost[i] = list(x[i]), costs[i]
        expected += [rights, lefts, deepcopy(x)]
        i = costs.index(min(costs))
        factor = 1.0 + 0.03 * tan((0.35 * rng.random() - 0.2) * pi)  # (25)
        x[i] = [x[i][j] * factor for j in range(2)]
        if plane(*x[i]) < own_cost[i]:
            own[i], own_cost[i] = list(x[i]), plane(*x[i])
        expected.append([x[i]])
        d = 0.95 * d + 0.01  # (13)
    objective.was_asked(expected)
    np.testing.assert_allclose(found.beetles, x, rtol=1e-9)
    assert found.value == pytest.approx(min(own_cost), rel=1e-9)


def test_ibas_takes_the_better_of_a_short_and_a_long_way() -> None:
    objective, start = Plane(), swarm(0, 7, 2)
    found = run("ibas", objective, start, 2, seed=8)
    rng = np.random.default_rng(8)
    x, velocity, own = start, np.zeros((7, 2)), start
    smelled = start
    expected = [start.tolist()]
    for inertia in (1.0, 0.65):
        # The two best of two dimensions, weighing log(2.5 / 1) and log(2.5 / 2).
        first, second = sorted(smelled.tolist(), key=lambda point: plane(*point))[:2]
        weights = np.log(2.5), np.log(1.25)
        centre = (weights[0] * np.array(first) + weights[1] * np.array(second)) / sum(weights)
        r1, r2 = rng.random((2, 7, 2))
        velocity = inertia * velocity + 2.0 * r1 * (own - x) + 2.0 * r2 * (centre - x)
        far, near = x + 1.375 * velocity, x + 0.625 * velocity
        moved = np.array([min(ways, key=lambda point: plane(*point)) for ways in zip(far, near, strict=True)])
        velocity, x = moved - x, moved
        own = np.array([min(pair, key=lambda point: plane(*point)) for pair in zip(own, x, strict=True)])
        smelled = np.concatenate([far, near])
        best = min(range(7), key=lambda i: plane(*own[i]))
        spread = np.abs(x - x.mean(axis=0)).mean(axis=0)
        disturbed = own[best] + 0.03 * spread * np.tan(np.pi * (rng.random(2) - 0.5))
        if plane(*disturbed) < plane(*own[best]):
            own[best] = disturbed
        expected += [far.tolist(), near.tolist(), [disturbed.tolist()]]
    objective.was_asked(expected)
    np.testing.assert_allclose(found.beetles, x, rtol=1e-9)


@pytest.mark.parametrize("level", [3.0, np.nan])
def test_bas_stays_where_no_side_is_better(level: float) -> None:
    found = run("bas", lambda points: np.full(len(points), level), START, 5)
    np.testing.assert_array_equal(found.beetles, START)


@given(places, seeds)
@settings(max_examples=10)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_ibas_finds_the_bottom_wherever_it_is(dimensions: int, optimum: FloatArray, seed: int) -> None:
    optimum = optimum[:dimensions]
    found = run("ibas", valley(optimum), swarm(seed, 20, dimensions), 120, seed)
    np.testing.assert_allclose(found.point, optimum, atol=1e-6)


@given(places, seeds)
@settings(max_examples=10)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_bas_finds_the_bottom_wherever_it_is(dimensions: int, optimum: FloatArray, seed: int) -> None:
    optimum = optimum[:dimensions]
    search = BeetleAntennaeSearch(step=10.0)
    start = swarm(seed, 4, dimensions)
    found = search.search(valley(optimum), start, 300, np.random.default_rng(seed))
    np.testing.assert_allclose(found.point, optimum, atol=2e-3)


@given(places, seeds)
@settings(max_examples=10)
@pytest.mark.parametrize("name", CORRECTED)
def test_shifting_the_function_shifts_the_path(name: str, shift: FloatArray, seed: int) -> None:
    start = swarm(seed)
    here = run(name, ripples, start, 8, seed)
    there = run(name, lambda points: ripples(points - shift), start + shift, 8, seed)
    np.testing.assert_allclose(there.beetles, here.beetles + shift, atol=1e-8)
    np.testing.assert_allclose(there.history, here.history, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ALL)
def test_scale_stretches_the_path_along_each_axis(name: str) -> None:
    scale = np.array([1.0, 0.125, 64.0])  # powers of two: exact
    start = swarm(3)
    plain = run(name, ripples, start, 10, seed=4)
    stretched = SEARCHES[name]().search(
        lambda points: ripples(points / scale), start * scale, 10, np.random.default_rng(4), scale
    )
    np.testing.assert_array_equal(stretched.beetles, plain.beetles * scale)
    np.testing.assert_array_equal(stretched.point, plain.point * scale)
    assert stretched.value == plain.value


def test_ibas_needs_no_scale() -> None:
    stretch = np.array([1.0, 0.125, 64.0])
    start = swarm(3)
    plain = run("ibas", ripples, start, 10, seed=4)
    stretched = run("ibas", lambda points: ripples(points / stretch), start * stretch, 10, seed=4)
    np.testing.assert_array_equal(stretched.beetles, plain.beetles * stretch)


@given(seeds, st.integers(1, 9), st.integers(1, 12))
@settings(max_examples=15)
@pytest.mark.parametrize("name", ALL)
def test_history_falls_from_the_start_to_the_value_found(
    name: str, seed: int, beetles: int, iterations: int
) -> None:
    start = swarm(seed, beetles)
    found = run(name, ripples, start, iterations, seed)
    assert found.history.shape == (iterations + 1,)
    assert found.beetles.shape == start.shape
    assert found.history[0] == ripples(start).min()
    assert np.all(np.diff(found.history) <= 0.0)
    assert found.history[-1] == found.value == ripples(found.point[None])[0]


@pytest.mark.parametrize("beetles", [1, 2, 7])
@pytest.mark.parametrize("name", ALL)
def test_every_point_asked_is_counted(name: str, beetles: int) -> None:
    asked = 0

    def counting(points: FloatArray) -> FloatArray:
        nonlocal asked
        asked += len(points)
        return ripples(points)

    found = run(name, counting, swarm(1, beetles), 6)
    assert found.evaluations == asked
    assert asked == beetles + 6 * SEARCHES[name]().evaluations_per_iteration(beetles)


@pytest.mark.parametrize("name", ALL)
def test_the_same_seed_gives_the_same_path(name: str) -> None:
    start = swarm(2)
    once, again, other = (run(name, ripples, start, 9, seed) for seed in (11, 11, 12))
    np.testing.assert_array_equal(once.beetles, again.beetles)
    np.testing.assert_array_equal(once.history, again.history)
    assert not np.array_equal(once.beetles, other.beetles)
    np.testing.assert_array_equal(start, swarm(2))


@given(seeds)
@settings(max_examples=10)
@pytest.mark.parametrize("name", ALL)
def test_a_point_without_cost_is_never_the_best(name: str, seed: int) -> None:
    def half(points: FloatArray) -> FloatArray:
        # The bottom itself, and all beyond it, has no cost.
        return np.where(points[:, 0] < 0.5, np.nan, valley(0.0)(points))

    start = swarm(seed)
    start[0, 0] = 3.0
    found = run(name, half, start, 30, seed)
    assert np.isfinite(found.value)
    assert found.point[0] >= 0.5
    assert half(found.point[None])[0] == found.value
    assert np.isfinite(found.history).all()


@pytest.mark.parametrize("name", ALL)
def test_without_any_cost_the_start_is_what_remains(name: str) -> None:
    start = swarm(5)
    found = run(name, lambda points: np.full(len(points), np.nan), start, 10)
    assert found.value == np.inf
    np.testing.assert_array_equal(found.point, start[0])
    assert np.isfinite(found.beetles).all()


@given(seeds, st.floats(0.01, 3.0), st.floats(1e-3, 1e3))
@settings(max_examples=15)
@pytest.mark.parametrize("name", ALL)
def test_no_point_outside_the_bounds_is_tried(name: str, seed: int, width: float, scale: float) -> None:
    low, high = np.array([-1.0, 0.3, -2.0]), np.array([-1.0, 0.3, -2.0]) + width
    tried: list[FloatArray] = []

    def recording(points: FloatArray) -> FloatArray:
        tried.append(points.copy())
        return ripples(points)

    found = SEARCHES[name]().search(
        recording, swarm(seed), 12, np.random.default_rng(seed), scale, bounds=(low, high)
    )
    for points in (*tried, found.beetles, found.point[None]):
        assert np.all(points >= low)
        assert np.all(points <= high)


def test_beyond_a_bound_the_best_is_on_it() -> None:
    found = SEARCHES["ibas"]().search(
        valley(5.0), swarm(1, 20), 60, np.random.default_rng(1), bounds=(-4.0, np.array([4.0, 6.0, 6.0]))
    )
    np.testing.assert_allclose(found.point, [4.0, 5.0, 5.0], atol=1e-3)


@pytest.mark.parametrize("name", ["bas_printed", "ibas_printed", "ibas_prose"])
def test_the_corrected_swarm_does_what_the_prints_do_not(name: str) -> None:
    optimum = np.random.default_rng(0).uniform(-40.0, 40.0, 10)
    start = np.random.default_rng(1).uniform(-50.0, 50.0, (20, 10))
    assert (
        run("ibas", valley(optimum), start, 100).value < 1e-3 < run(name, valley(optimum), start, 100).value
    )
