"""How costs grow: time against what there is more of, and the exponent of a power law through it."""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from companion.config import Config, load_config
from companion.estimator_choice import chosen_settings
from companion.log import RawChunk
from companion.pipeline import Chain, make_pipeline
from companion.shipped_files import params_dir
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS, records
from estimators import make_estimator
from estimators.base import Setup
from estimators.messages import Measurement, PoseIncrement, RangeFrame

_ROUNDS = 3
_UPDATES = 150


@dataclass(frozen=True, slots=True)
class Curve:
    """Cost against one size.

    Attributes:
        name: what grows.
        unit: of the cost.
        sizes: of it.
        costs: at these sizes, best of some rounds.
    """

    name: str
    unit: str
    sizes: list[float]
    costs: list[float]

    @property
    def exponent(self) -> float:
        """Slope of the cost over the size, both logarithmic, from the second half of the sizes."""
        half = len(self.sizes) // 2
        return float(np.polyfit(np.log(self.sizes[half:]), np.log(self.costs[half:]), 1)[0])


def particles() -> Curve:
    """Time of a frame of ranges in the particle filter."""
    sizes = [50, 100, 200, 400, 800, 1600, 3200]
    config = load_config(params_dir() / "sites" / "huang2024.toml")
    return _curve("pf: particles", sizes, lambda size: _update_us(config, f"pf:{size}", config.setup()))


def anchors() -> Curve:
    """Time of a frame of ranges in `ekf`, with as many anchors round the room."""
    sizes = [4, 8, 16, 32]
    config = load_config(params_dir() / "sites" / "huang2024.toml")

    def cost(size: int) -> float:
        angles = np.arange(size) * 2.0 * np.pi / size
        ring = {
            i: np.array([4.0 + 5.0 * np.cos(angle), 4.0 + 5.0 * np.sin(angle), 1.5])
            for i, angle in enumerate(angles)
        }
        setup = config.setup()
        return _update_us(config, "ekf", replace(setup, anchors=ring))

    return _curve("ekf: anchors", sizes, cost)


def log_length() -> Curve:
    """Time of the whole chain for a log of so many seconds: one walk, again and again."""
    scenario = load_scenario(params_dir() / "scenarios" / "square_room.toml", 1, [])
    walk = [record for record in records(scenario) if isinstance(record, RawChunk)]
    period_ns = walk[-1].stamp_ns - walk[0].stamp_ns + 4_000_000
    sizes = [1, 2, 4]

    def seconds(laps: int) -> float:
        chain = Chain(scenario.config, START_NS, make_pipeline(scenario.config, ["ekf"]), "ekf")
        begin = time.process_time()
        for lap in range(laps):
            for chunk in walk:
                for _ in chain.feed(replace(chunk, stamp_ns=chunk.stamp_ns + lap * period_ns)):
                    pass
        return time.process_time() - begin

    return Curve(
        "chain: seconds of log", "s", [n * period_ns * 1e-9 for n in sizes], [seconds(n) for n in sizes]
    )


def curves_table(curves: list[Curve], title: str) -> Table:
    """A line for every curve."""
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for heading in ("what grows", "size: cost", "exponent"):
        table.add_column(heading)
    for curve in curves:
        points = zip(curve.sizes, curve.costs, strict=True)
        costs = ", ".join(f"{size:.0f}: {cost:.3g}" for size, cost in points)
        table.add_row(f"{curve.name} [{curve.unit}]", costs, f"{curve.exponent:.2f}")
    return table


def _curve(name: str, sizes: list[int], cost: Callable[[int], float]) -> Curve:
    costs = [min(cost(size) for _ in range(_ROUNDS)) for size in sizes]
    return Curve(name, "us/frame", [float(size) for size in sizes], costs)


def _update_us(config: Config, choice: str, setup: Setup) -> float:
    """CPU time of a frame of ranges to all anchors [us], on a slow straight walk."""
    estimator = make_estimator(choice.partition(":")[0], chosen_settings(config, choice, "bench"), setup)
    gc.collect()
    gc.disable()
    spent = 0.0
    try:
        for measurement in _straight_walk(setup):
            begin = time.process_time()
            estimator.update(measurement)
            if isinstance(measurement, RangeFrame):
                spent += time.process_time() - begin
    finally:
        gc.enable()
    return 1e6 * spent / _UPDATES


def _straight_walk(setup: Setup) -> Iterator[Measurement]:
    rng = np.random.default_rng(1)
    ids = np.array(list(setup.anchors))
    places = np.array(list(setup.anchors.values()))
    none = np.full(len(ids), np.nan)
    cov = np.diag([1e-4, 1e-4, 1e-5])
    x, y, _ = setup.start.pose
    for k in range(_UPDATES):
        stamp_ns = START_NS + k * 100_000_000
        before_ns = stamp_ns - 100_000_000 if k else stamp_ns
        step = np.array([0.02 if k else 0.0, 0.0, 0.0])
        yield PoseIncrement(before_ns, stamp_ns, step, cov, is_keyframe=True)
        tag = np.array([x + 0.02 * k, y, setup.height]) + setup.tag_in_body
        ranges = np.linalg.norm(places - tag, axis=1) + 0.1 * rng.standard_normal(len(ids))
        yield RangeFrame(stamp_ns, 1, ids, ranges, none, none)


CURVES: tuple[Callable[[], Curve], ...] = (particles, anchors, log_length)
