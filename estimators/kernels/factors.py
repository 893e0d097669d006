"""Factors of a graph: residual, loss, and what each adds to the normal equations.

The functions here are those of `estimators.models` and `estimators.graph.losses`, against which the tests
hold them. A graph is a tuple of matrices; `estimators.graph.factors` says what their rows are. A system is a
tuple of elimination order, pattern of the factor (`kernels.block_cholesky`) and slots: for each factor the
places of its blocks off the diagonal.
"""

from math import atan2, cos, log1p, sin, sqrt
from typing import TypeAlias

import numpy as np

from estimators.kernels.algebra import wrapped
from estimators.kernels.block_cholesky import BLOCKS, pattern, place_of
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.messages import FloatArray, IntArray

GraphArrays: TypeAlias = tuple[
    FloatArray,  # free
    FloatArray,  # increments
    FloatArray,  # ranges
    FloatArray,  # sightings
    FloatArray,  # motions
    FloatArray,  # priors
    IntArray,  # variables of the dense prior
    FloatArray,  # where it was linearised
    FloatArray,  # its information
    FloatArray,  # its gradient there
]
Slots: TypeAlias = tuple[IntArray, IntArray, IntArray, IntArray, IntArray]
System: TypeAlias = tuple[IntArray, IntArray, IntArray, Slots]

GRAPH = f"Tuple(({', '.join([MATRIX] * 6)}, {INDICES}, {MATRIX}, {MATRIX}, {VECTOR}))"
_TABLE = "int64[:, ::1]"
SLOTS = f"Tuple(({INDICES}, {INDICES}, {INDICES}, {_TABLE}, {_TABLE}))"
SYSTEM = f"Tuple(({INDICES}, {INDICES}, {INDICES}, {SLOTS}))"

_NOWHERE = 1e-9
"""Least distance [m] that a direction is computed with."""


@compiled(f"{INDICES}({GRAPH})")
def last_use(graph: GraphArrays) -> IntArray:
    """Highest number of the variables that share a factor with each, (V,); -1 where there is none.

    Numbers grow with time: this says when a variable is needed for the last time.
    """
    free, increments, ranges, sightings, motions, priors, dense, _, _, _ = graph
    last = np.full(len(free), -1, dtype=np.int64)
    for table in (increments, ranges, sightings):
        for k in range(len(table)):
            i, j = int(table[k, 0]), int(table[k, 1])
            newest = max(i, j)
            last[i], last[j] = max(last[i], newest), max(last[j], newest)
    for k in range(len(motions)):
        newest = 0
        for c in range(4):
            newest = max(newest, int(motions[k, c]))
        for c in range(4):
            last[int(motions[k, c])] = max(last[int(motions[k, c])], newest)
    for k in range(len(priors)):
        i = int(priors[k, 0])
        last[i] = max(last[i], i)
    if len(dense) > 0:
        newest = dense.max()
        for i in dense:
            last[i] = max(last[i], newest)
    return last


@compiled(f"void({_TABLE}, int64, int64, int64)")
def _note_pair(pairs: IntArray, n: int, i: int, j: int) -> None:
    pairs[n, 0], pairs[n, 1] = (min(i, j), max(i, j)) if min(i, j) >= 0 else (-1, -1)


@compiled(f"{_TABLE}({GRAPH}, {INDICES})")
def connected_pairs(graph: GraphArrays, order: IntArray) -> IntArray:
    """Places (P, 2), lower first, of variables that share a factor; (-1, -1) where one of them is fixed."""
    _, increments, ranges, sightings, motions, _, dense, _, _, _ = graph
    count = len(increments) + len(ranges) + len(sightings) + 6 * len(motions)
    pairs = np.empty((count + len(dense) * (len(dense) - 1) // 2, 2), dtype=np.int64)
    n = 0
    for table in (increments, ranges, sightings):
        for k in range(len(table)):
            _note_pair(pairs, n, order[int(table[k, 0])], order[int(table[k, 1])])
            n += 1
    for k in range(len(motions)):
        for a in range(4):
            for b in range(a):
                _note_pair(pairs, n, order[int(motions[k, a])], order[int(motions[k, b])])
                n += 1
    for a in range(len(dense)):
        for b in range(a):
            _note_pair(pairs, n, order[dense[a]], order[dense[b]])
            n += 1
    return pairs


@compiled(f"{SYSTEM}({GRAPH}, {INDICES}, int64)")
def system_of(graph: GraphArrays, order: IntArray, count: int) -> System:
    """Pattern of the factor, and slots, for an elimination order.

    Args:
        graph: its factors.
        order: (V,) place of each variable; negative for one that is fixed.
        count: number of variables that are not.
    """
    _, increments, ranges, sightings, motions, _, dense, _, _, _ = graph
    pairs = connected_pairs(graph, order)
    starts, rows = pattern(count, pairs)
    slots = np.full(len(pairs), -1, dtype=np.int64)
    for n in range(len(pairs)):
        if pairs[n, 0] >= 0:
            slots[n] = place_of(starts, rows, pairs[n, 0], pairs[n, 1])
    a, b = len(increments), len(increments) + len(ranges)
    c = b + len(sightings)
    d = c + 6 * len(motions)
    of_dense = np.full((len(dense), len(dense)), -1, dtype=np.int64)
    n = d
    for i in range(len(dense)):
        for j in range(i):
            of_dense[i, j] = slots[n]
            n += 1
    return (
        order,
        starts,
        rows,
        (
            slots[:a].copy(),
            slots[a:b].copy(),
            slots[b:c].copy(),
            slots[c:d].copy().reshape(len(motions), 6),
            of_dense,
        ),
    )


@compiled("UniTuple(float64, 2)(float64, float64, float64, float64)")
def loss(kind: float, scale: float, square: float, sign: float) -> tuple[float, float]:
    """Loss and weight of a residual, as `estimators.graph.losses` has them.

    Args:
        kind: 0 Gaussian, 1 Huber, 2 Cauchy, 3 Cauchy if the residual is positive, else Gaussian.
        scale: of the loss, in standard deviations.
        square: squared residual in units of its standard deviation.
        sign: positive for a measurement that is greater than predicted.
    """
    if kind == 1.0 and square > scale * scale:
        size = sqrt(square)
        return scale * (size - 0.5 * scale), scale / size
    if kind == 2.0 or (kind == 3.0 and sign > 0.0):
        ratio = square / (scale * scale)
        return 0.5 * scale * scale * log1p(ratio), 1.0 / (1.0 + ratio)
    return 0.5 * square, 1.0


@compiled(
    f"void({MATRIX}, {BLOCKS}, {BLOCKS}, {INDICES}, int64, int64, int64, "
    f"{MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, int64)"
)
def _add(
    gradient: FloatArray,
    diagonal: FloatArray,
    below: FloatArray,
    order: IntArray,
    first: int,
    second: int,
    slot: int,
    by_first: FloatArray,
    by_second: FloatArray,
    information: FloatArray,
    residual: FloatArray,
    size: int,
) -> None:
    """Add a factor on two variables: J^T W J and J^T W e, with `size` rows in J, W and e."""
    i, j = order[first], order[second]
    for r in range(size):
        for s in range(size):
            w = information[r, s]
            if w == 0.0:
                continue
            for a in range(3):
                left = by_first[r, a] * w
                right = by_second[r, a] * w
                if i >= 0:
                    gradient[i, a] += left * residual[s]
                    for b in range(3):
                        diagonal[i, a, b] += left * by_first[s, b]
                if j >= 0:
                    gradient[j, a] += right * residual[s]
                    for b in range(3):
                        diagonal[j, a, b] += right * by_second[s, b]
                if i >= 0 and j >= 0:
                    for b in range(3):
                        if i > j:
                            below[slot, a, b] += left * by_second[s, b]
                        else:
                            below[slot, a, b] += right * by_first[s, b]


@compiled(f"float64({MATRIX}, {GRAPH}, {SYSTEM}, {MATRIX}, {BLOCKS}, {BLOCKS}, boolean)")
def linearise(
    values: FloatArray,
    graph: GraphArrays,
    system: System,
    gradient: FloatArray,
    diagonal: FloatArray,
    below: FloatArray,
    with_system: bool,
) -> float:
    """Cost of the graph; and its normal equations ``H dx = g``, written into the arrays, if asked for.

    Args:
        values: (V, 3) of all variables.
        graph: factors.
        system: where they go.
        gradient: (N, 3) g, downhill, in elimination order.
        diagonal: (N, 3, 3) of H.
        below: (M, 3, 3) of H.
        with_system: False: the cost alone.

    Source: huang2024 Eq. (29)-(38); weights of robust losses: iteratively reweighted least squares.
    """
    free, increments, ranges, sightings, motions, priors, dense, dense_at, dense_information, dense_pull = (
        graph
    )
    order, _, _, (slots_i, slots_r, slots_s, slots_m, slots_d) = system
    if with_system:
        gradient[:] = 0.0
        diagonal[:] = 0.0
        below[:] = 0.0
    A, B, W = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    e, pull = np.zeros(3), np.zeros(3)
    cost, c, s = 0.0, 1.0, 0.0

    for k in range(len(increments)):
        row = increments[k]
        i, j = int(row[0]), int(row[1])
        c, s = cos(values[i, 2]), sin(values[i, 2])
        dx, dy = values[j, 0] - values[i, 0], values[j, 1] - values[i, 1]
        along, across = c * dx + s * dy, c * dy - s * dx
        e[0], e[1] = row[2] - along, row[3] - across
        e[2] = wrapped(row[4] - values[j, 2] + values[i, 2])
        square = 0.0
        for r in range(3):
            for t in range(3):
                square += e[r] * row[5 + 3 * r + t] * e[t]
        rho, weight = loss(row[14], row[15], square, 1.0)
        cost += row[16] * rho
        if with_system:
            # With residual and information turned into the map, one Jacobian is the identity.
            w = row[16] * weight
            for t in range(3):
                A[0, t] = w * (c * row[5 + t] - s * row[8 + t])
                A[1, t] = w * (s * row[5 + t] + c * row[8 + t])
                A[2, t] = w * row[11 + t]
            for r in range(3):
                W[r, 0], W[r, 1], W[r, 2] = c * A[r, 0] - s * A[r, 1], s * A[r, 0] + c * A[r, 1], A[r, 2]
                pull[r] = A[r, 0] * e[0] + A[r, 1] * e[1] + A[r, 2] * e[2]
            for t in range(3):
                B[0, t], B[1, t], B[2, t] = -W[0, t], -W[1, t], dy * W[0, t] - dx * W[1, t] - W[2, t]
            p, q = order[i], order[j]
            if p >= 0:
                gradient[p, 0] -= pull[0]
                gradient[p, 1] -= pull[1]
                gradient[p, 2] += dy * pull[0] - dx * pull[1] - pull[2]
                for r in range(3):
                    diagonal[p, r, 0] -= B[r, 0]
                    diagonal[p, r, 1] -= B[r, 1]
                    diagonal[p, r, 2] += dy * B[r, 0] - dx * B[r, 1] - B[r, 2]
            if q >= 0:
                for r in range(3):
                    gradient[q, r] += pull[r]
                    for t in range(3):
                        diagonal[q, r, t] += W[r, t]
                        if p > q:
                            below[slots_i[k], r, t] += B[r, t]
                        elif p >= 0:
                            below[slots_i[k], r, t] += B[t, r]

    turned = -1
    for k in range(len(ranges)):
        row = ranges[k]
        i, j = int(row[0]), int(row[1])
        if i != turned:  # ranges of one frame follow one another
            turned, c, s = i, cos(values[i, 2]), sin(values[i, 2])
        arm_x, arm_y = c * row[4] - s * row[5], s * row[4] + c * row[5]
        dx, dy = values[i, 0] + arm_x - values[j, 0], values[i, 1] + arm_y - values[j, 1]
        distance = max(sqrt(dx * dx + dy * dy + row[6] * row[6]), _NOWHERE)
        e[0] = row[2] - distance - values[j, 2]
        information = 1.0 / (row[3] * row[3])
        rho, weight = loss(row[7], row[8], e[0] * e[0] * information, e[0])
        cost += rho
        if with_system:
            ux, uy = dx / distance, dy / distance
            u_yaw = (uy * arm_x - ux * arm_y) * free[i, 2]
            w = weight * information
            p, q = order[i], order[j]
            if p >= 0:
                for a, left in ((0, w * ux), (1, w * uy), (2, w * u_yaw)):
                    gradient[p, a] += left * e[0]
                    diagonal[p, a, 0] += left * ux
                    diagonal[p, a, 1] += left * uy
                    diagonal[p, a, 2] += left * u_yaw
            if q >= 0:
                x, y, b = -ux * free[j, 0], -uy * free[j, 1], free[j, 2]
                for a, left in ((0, w * x), (1, w * y), (2, w * b)):
                    gradient[q, a] += left * e[0]
                    diagonal[q, a, 0] += left * x
                    diagonal[q, a, 1] += left * y
                    diagonal[q, a, 2] += left * b
                if p >= 0:
                    slot = slots_r[k]
                    if p > q:
                        for a, left in ((0, w * ux), (1, w * uy), (2, w * u_yaw)):
                            below[slot, a, 0] += left * x
                            below[slot, a, 1] += left * y
                            below[slot, a, 2] += left * b
                    else:
                        for a, left in ((0, w * x), (1, w * y), (2, w * b)):
                            below[slot, a, 0] += left * ux
                            below[slot, a, 1] += left * uy
                            below[slot, a, 2] += left * u_yaw

    for k in range(len(sightings)):
        row = sightings[k]
        i, j = int(row[0]), int(row[1])
        dx, dy = values[j, 0] - values[i, 0], values[j, 1] - values[i, 1]
        distance = max(sqrt(dx * dx + dy * dy), _NOWHERE)
        e[0], e[1] = row[2] - distance, wrapped(row[3] + values[i, 2] - atan2(dy, dx))
        by_range, by_bearing = 1.0 / (row[4] * row[4]), 1.0 / (row[5] * row[5])
        rho, weight = loss(row[6], row[7], e[0] * e[0] * by_range + e[1] * e[1] * by_bearing, 1.0)
        cost += rho
        if with_system:
            ux, uy = dx / distance, dy / distance
            A[0, 0], A[0, 1], A[0, 2] = -ux, -uy, 0.0
            A[1, 0], A[1, 1], A[1, 2] = uy / distance, -ux / distance, -1.0
            for r in range(2):
                for t in range(2):
                    B[r, t] = -A[r, t] * free[j, t]
                B[r, 2] = 0.0
            W[:] = 0.0
            W[0, 0], W[1, 1] = weight * by_range, weight * by_bearing
            _add(gradient, diagonal, below, order, i, j, slots_s[k], A, B, W, e, 2)

    for k in range(len(motions)):
        row = motions[k]
        dt = row[4]
        of_place, mixed, of_speed = 12.0 / dt**3, -6.0 / dt**2, 4.0 / dt
        # Of earlier position and velocity, later position and velocity: lower half, row by row.
        weights = (
            *(of_place, -mixed, of_speed),
            *(-of_place, mixed, of_place),
            *(-mixed, 0.5 * of_speed, mixed, of_speed),
        )
        for axis in range(3):
            density = row[5] if axis < 2 else row[6]
            w = 1.0 / (density * density)
            place = values[int(row[0]), axis] + dt * values[int(row[1]), axis] - values[int(row[2]), axis]
            speed = values[int(row[1]), axis] - values[int(row[3]), axis]
            pull_place, pull_speed = (
                w * (of_place * place + mixed * speed),
                w * (mixed * place + of_speed * speed),
            )
            cost += 0.5 * (place * pull_place + speed * pull_speed)
            if with_system and free[int(row[0]), axis] != 0.0:
                pulls = (-pull_place, -dt * pull_place - pull_speed, pull_place, pull_speed)
                n = 0
                for a in range(4):
                    for _ in range(a):
                        if slots_m[k, n] >= 0:
                            below[slots_m[k, n], axis, axis] += w * weights[n + a]
                        n += 1
                    i = order[int(row[a])]
                    if i >= 0:
                        gradient[i, axis] += pulls[a]
                        diagonal[i, axis, axis] += w * weights[n + a]

    for k in range(len(priors)):
        row = priors[k]
        i = int(row[0])
        for a in range(3):
            e[a] = row[1 + a] - values[i, a]
        if row[13] == 1.0:
            e[2] = wrapped(e[2])
        for a in range(3):
            for b in range(3):
                w = row[4 + 3 * a + b] * e[b]
                cost += 0.5 * e[a] * w
                if with_system and order[i] >= 0:
                    gradient[order[i], a] += free[i, a] * w
                    diagonal[order[i], a, b] += free[i, a] * row[4 + 3 * a + b] * free[i, b]

    for p in range(len(dense)):
        i = order[dense[p]]
        for a in range(3):
            d = values[dense[p], a] - dense_at[p, a]
            downhill = dense_pull[3 * p + a]
            for q in range(len(dense)):
                j = order[dense[q]]
                for b in range(3):
                    w = dense_information[3 * p + a, 3 * q + b]
                    downhill -= w * (values[dense[q], b] - dense_at[q, b])
                    if with_system:
                        w *= free[dense[p], a] * free[dense[q], b]
                        if p == q:
                            diagonal[i, a, b] += w
                        elif q < p and i > j:
                            below[slots_d[p, q], a, b] += w
                        elif q < p:
                            below[slots_d[p, q], b, a] += w
            # At d the cost is d^T L d / 2 - dense_pull^T d, and downhill is dense_pull - L d.
            cost -= 0.5 * d * (downhill + dense_pull[3 * p + a])
            if with_system:
                gradient[i, a] += free[dense[p], a] * downhill

    if with_system:
        for i in range(len(free)):
            if order[i] >= 0:
                for a in range(3):
                    if free[i, a] == 0.0:
                        diagonal[order[i], a, a] = 1.0
    return cost
