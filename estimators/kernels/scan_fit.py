"""Gauss-Newton of scan matching: sums over matched points, what walls hold, and the states that fit."""

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, solve_upper
from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.kernels.scan_lines import INTEGERS, IntegerArray, associate
from estimators.messages import FloatArray

HELD_RATIO = 5.0
"""Walls hold a direction when a scan says so many times more of it than noise of the normals feigns."""
LEAST_MATCHED = 10
"""With fewer matched points there is no match."""
CONVERGED = 1e-4
"""A step of the pose that is smaller [m, rad] is the last."""
MOST_ITERATIONS = 20


@compiled(
    f"Tuple(({MATRIX}, {VECTOR}, {MATRIX}, {MATRIX}, float64, float64))"
    f"({MATRIX}, {MATRIX}, {INTEGERS}, {MATRIX}, float64)"
)
def normal_equations(
    basis: FloatArray, rows: FloatArray, index: IntegerArray, lines: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float, float]:
    """Sums of Gauss-Newton over all matched points, with Cauchy weights.

    Args:
        basis: (N, 4) as for `associate`.
        rows: (N, 6) of `associate`.
        index: (N,) of `associate`.
        lines: (M, 6).
        scale: of the Cauchy weight [m].

    Returns:
        Hessian (12, 12) and gradient (12,) for unit variance; Hessian (3, 3) by the pose alone; what noise of
        the normals adds to it on average (3, 3); sum of the weights; weighted sum of squared distances [m^2].
    """
    # Rows: by pairs of the pose's numbers (0 0, 1 0, 1 1, 2 0, 2 1, 2 2); columns: by pairs of the basis.
    # Written out because the compiler then takes four columns at once.
    blocks, pairs, pull = np.zeros((6, 16)), np.empty(16), np.zeros((3, 4))
    of_pose, of_noise = np.zeros(6), np.zeros(6)
    total, squares = 0.0, 0.0
    for i in range(len(rows)):
        k = index[i]
        if k < 0:
            continue
        r, x, y, yaw = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        weight = 1.0 / (1.0 + (r / scale) ** 2)
        total += weight
        squares += weight * r * r
        # What a turn of the normal by 1 rad does to the derivative (x, y, yaw): -y, x and this.
        turned = x * rows[i, 4] + y * rows[i, 5]
        noise = weight * lines[k, 4]
        of_noise[0] += noise * y * y
        of_noise[1] -= noise * y * x
        of_noise[2] += noise * x * x
        of_noise[3] -= noise * y * turned
        of_noise[4] += noise * x * turned
        of_noise[5] += noise * turned * turned
        wx, wy, wyaw = weight * x, weight * y, weight * yaw
        xx, xy, yy, x_yaw, y_yaw, yaw_yaw = wx * x, wx * y, wy * y, wx * yaw, wy * yaw, wyaw * yaw
        of_pose[0] += xx
        of_pose[1] += xy
        of_pose[2] += yy
        of_pose[3] += x_yaw
        of_pose[4] += y_yaw
        of_pose[5] += yaw_yaw
        for p in range(4):
            for q in range(4):
                pairs[4 * p + q] = basis[i, p] * basis[i, q]
        for n in range(16):
            pair = pairs[n]
            blocks[0, n] += xx * pair
            blocks[1, n] += xy * pair
            blocks[2, n] += yy * pair
            blocks[3, n] += x_yaw * pair
            blocks[4, n] += y_yaw * pair
            blocks[5, n] += yaw_yaw * pair
        for p in range(4):
            share = basis[i, p] * r
            pull[0, p] += wx * share
            pull[1, p] += wy * share
            pull[2, p] += wyaw * share
    hessian, gradient = np.empty((12, 12)), np.empty(12)
    pose, feigned = np.empty((3, 3)), np.empty((3, 3))
    m = 0
    for a in range(3):
        for p in range(4):
            gradient[3 * p + a] = pull[a, p]
        for b in range(a + 1):
            pose[a, b] = pose[b, a] = of_pose[m]
            feigned[a, b] = feigned[b, a] = of_noise[m]
            for p in range(4):
                for q in range(4):
                    hessian[3 * p + a, 3 * q + b] = hessian[3 * p + b, 3 * q + a] = blocks[m, 4 * p + q]
            m += 1
    return hessian, gradient, pose, feigned, total, squares


@compiled(f"{MATRIX}({MATRIX}, {INTEGERS}, float64, int64[:, ::1], int64)")
def gradient_noise(
    rows: FloatArray, index: IntegerArray, scale: float, spans: IntegerArray, count: int
) -> FloatArray:
    """Covariance (3, 3) of the gradient by the pose from noise of variance 1 of the points of the lines.

    Lines share their points with their neighbours, and many points may be matched to one line.

    Args:
        rows: (N, 6) of `associate`.
        index: (N,) of `associate`.
        scale: of the Cauchy weight [m].
        spans: (M, 2) first and last point of each line.
        count: number of points that the lines go through.
    """
    change, noise, share = np.zeros((count + 1, 3)), np.zeros((3, 3)), np.zeros(3)
    for i in range(len(rows)):
        k = index[i]
        if k < 0:
            continue
        first, last = spans[k, 0], spans[k, 1]
        weight = 1.0 / (1.0 + (rows[i, 0] / scale) ** 2) / (last - first + 1)
        for a in range(3):
            change[first, a] += weight * rows[i, 1 + a]
            change[last + 1, a] -= weight * rows[i, 1 + a]
    for i in range(count):
        share += change[i]
        for a in range(3):
            for b in range(3):
                noise[a, b] += share[a] * share[b]
    return noise


@compiled(f"{MATRIX}({MATRIX}, {MATRIX})")
def held_directions(pose_hessian: FloatArray, feigned: FloatArray) -> FloatArray:
    """Projection (3, 3) of a change of the pose [m, rad] on what walls hold.

    Along a bare corridor the information is not zero: normals are noisy, so every line seems to hold a
    little. How much that is on average is known; a direction with hardly more than that is held by nothing.

    Args:
        pose_hessian: (3, 3) by the pose, for distances of unit variance.
        feigned: (3, 3) share of it that noise of the normals has on average.

    Source: after Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems",
    ICRA 2016; here noise is the measure.
    """
    noise = feigned + 1e-9 * np.trace(feigned) * np.eye(3)
    # Positive definite, as its leading minors tell, when every direction has more: nearly always.
    more = pose_hessian - HELD_RATIO * noise
    minor = more[0, 0] * more[1, 1] - more[0, 1] ** 2
    if more[0, 0] > 0.0 and minor > 0.0 and np.linalg.det(more) > 0.0:
        return np.eye(3)
    root = cholesky(noise)
    half = np.linalg.solve(root, pose_hessian)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.T.copy()))
    free = (values <= HELD_RATIO).sum()
    across, _ = np.linalg.qr(np.linalg.solve(root.T.copy(), vectors[:, :free].copy()))
    held: FloatArray = np.eye(3) - across.copy() @ across.T.copy()
    return held


@compiled(
    f"Tuple((int64, {VECTOR}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {INTEGERS}))"
    f"({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, int64[:, ::1], {INTEGERS}, {VECTOR}, int64, int64, {MATRIX}, "
    f"{VECTOR}, {VECTOR}, float64, float64)"
)
def settle(
    points: FloatArray,
    normals: FloatArray,
    basis: FloatArray,
    lines: FloatArray,
    spans: IntegerArray,
    begin: IntegerArray,
    grid: FloatArray,
    columns: int,
    count: int,
    prior: FloatArray,
    predicted: FloatArray,
    start: FloatArray,
    sigma: float,
    spread: float,
) -> tuple[int, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, IntegerArray]:
    """Minimise the distances of surface points from their lines and the deviation from the prediction.

    Args:
        points: (N, 2) [m] as for `associate`.
        normals: (N, 2) as for `associate`.
        basis: (N, 4) as for `associate`.
        lines: (M, 6) as for `associate`.
        spans: (M, 2) first and last point of each line.
        begin: as for `associate`.
        grid: (4,) as for `associate`.
        columns: as for `associate`.
        count: number of points that the lines go through.
        prior: (12, 12) information on the states beforehand.
        predicted: (12,) states beforehand.
        start: (12,) states to begin with.
        sigma: least standard deviation of a distance [m].
        spread: how far points may be off at the start [m]; at first nothing nearer is taken for an outlier.

    Returns:
        How many points are matched, fewer than `LEAST_MATCHED` when there is no fit; states (12,);
        information (12, 12) on them, the prior's included; projection (3, 3) of a change of the pose on what
        walls hold; share (3, 3) of the map's own noise in the covariance of the newer pose; what `associate`
        gave, (N, 6) and (N,).

    Source: Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020, for the spread.
    """
    states, matched = start.copy(), 0
    rows, index = np.empty((len(points), 6)), np.full(len(points), -1)
    distances = np.empty(len(points))
    of_all, information, held = np.zeros((12, 12)), prior, np.eye(3)
    pose_hessian, scale, variance = held, 1.0, 1.0
    for _ in range(MOST_ITERATIONS):
        matched = associate(points, normals, basis, states, lines, begin, grid, columns, rows, index)
        if matched < LEAST_MATCHED:
            return matched, states, information, held, held, rows, index
        # Cauchy weight; its scale is the noise of two scans, or 1.5 times the median distance when larger.
        scale, n, small, middle = 2.0 * sigma, 0, 0, matched // 2
        for i in range(len(points)):
            if index[i] >= 0:
                distances[n] = abs(rows[i, 0])
                small += 1.5 * distances[n] <= scale
                n += 1
        if small <= middle:
            scale = 1.5 * np.partition(distances[:matched], middle)[middle]
        hessian, gradient, pose_hessian, feigned, total, squares = normal_equations(
            basis, rows, index, lines, max(scale, spread)
        )
        held = held_directions(pose_hessian, feigned)
        for k in range(0, 12, 3):
            of_all[k : k + 3, k : k + 3] = held
        # Half of the squares is noise of the keyframe, which does not average out from scan to scan.
        variance = max(sigma**2, 0.5 * squares / total)
        information = prior + of_all @ hessian @ of_all / variance
        downhill = prior @ (predicted - states) - of_all @ gradient / variance
        root = cholesky(information)
        # What nothing holds goes on as predicted; else the least doubt of its direction would move it.
        step = of_all @ solve_upper(root, solve_lower(root, downhill))
        states += step
        if np.abs(step[6:9]).max() < CONVERGED and spread <= scale:
            break
        spread *= 0.5
    values, vectors = np.linalg.eigh(held @ pose_hessian @ held)
    gain = np.zeros((3, 3))
    for k in range(3):
        if values[k] > 1e-9 * values[2]:
            gain += np.outer(vectors[:, k], vectors[:, k]) / values[k]
    keyframe_cov = variance * gain @ gradient_noise(rows, index, scale, spans, count) @ gain
    return matched, states, information, held, keyframe_cov, rows, index
