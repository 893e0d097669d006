"""Measurements held against particles: residuals, gate and weights."""

from math import atan2, cos, exp, sin, sqrt

import numpy as np

from estimators.kernels.algebra import wrapped
from estimators.kernels.compilation import MATRIX, VECTOR, compiled, inlined
from estimators.messages import FloatArray


@inlined
def range_residual(x: float, y: float, c: float, s: float, arm: FloatArray, row: FloatArray) -> float:
    """Measured minus predicted range [m] of a body at (x, y) whose yaw has cosine c and sine s."""
    dx = x + c * arm[0] - s * arm[1] - row[0]
    dy = y + s * arm[0] + c * arm[1] - row[1]
    return float(row[2] - sqrt(dx * dx + dy * dy))


@inlined
def landmark_residuals(x: float, y: float, yaw: float, row: FloatArray) -> tuple[float, float]:
    """Measured minus predicted range [m] and bearing [rad] of a landmark, for a body at (x, y, yaw)."""
    dx, dy = row[0] - x, row[1] - y
    return row[2] - sqrt(dx * dx + dy * dy), wrapped(row[3] + yaw - atan2(dy, dx))


@compiled(f"{MATRIX}({MATRIX}, {VECTOR}, {MATRIX}, {MATRIX})")
def residuals(poses: FloatArray, arm: FloatArray, ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Measured minus predicted.

    Args:
        poses: (N, 3 or more) x [m], y [m], yaw [rad] in the first columns, map frame.
        arm: (3,) tag antenna in the body frame [m].
        ranges: (M, 4).
        landmarks: (L, 6).

    Returns:
        (N, M + 2 L): of the ranges, then range and bearing of each landmark.

    Source: huang2024 Eq. (26), exponent; models as in `estimators.models`.
    """
    out = np.empty((len(poses), len(ranges) + 2 * len(landmarks)))
    for i in range(len(poses)):
        x, y, yaw = poses[i, 0], poses[i, 1], poses[i, 2]
        c, s = cos(yaw), sin(yaw)
        k = 0
        for j in range(len(ranges)):
            out[i, k] = range_residual(x, y, c, s, arm, ranges[j])
            k += 1
        for j in range(len(landmarks)):
            out[i, k], out[i, k + 1] = landmark_residuals(x, y, yaw, landmarks[j])
            k += 2
    return out


@inlined
def _moments(values: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (K,) and the lower triangle of the covariance (K, K) of weighted values (N, K)."""
    count = values.shape[1]
    mean, cov = np.zeros(count), np.zeros((count, count))
    for i in range(len(values)):
        for j in range(count):
            mean[j] += weights[i] * values[i, j]
    for i in range(len(values)):
        for j in range(count):
            deviation = weights[i] * (values[i, j] - mean[j])
            for k in range(j + 1):
                cov[j, k] += deviation * (values[i, k] - mean[k])
    return mean, cov


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({MATRIX}, {VECTOR}, {VECTOR}, {MATRIX})")
def expected_residuals(
    particles: FloatArray, weights: FloatArray, arm: FloatArray, ranges: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured minus predicted ranges as the cloud expects them: mean (M,) [m] and covariance (M, M) [m^2].

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        arm: (3,) tag antenna in the body frame [m].
        ranges: (M, 4).
    """
    mean, cov = _moments(residuals(particles, arm, ranges, np.empty((0, 6))), weights)
    for j in range(len(cov)):
        for k in range(j):
            cov[k, j] = cov[j, k]
    return mean, cov


@inlined
def _sigmas(ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Standard deviations of measurements in the order of their residuals."""
    out = np.empty(len(ranges) + 2 * len(landmarks))
    for j in range(len(ranges)):
        out[j] = ranges[j, 3]
    for j in range(len(landmarks)):
        out[len(ranges) + 2 * j] = landmarks[j, 4]
        out[len(ranges) + 2 * j + 1] = landmarks[j, 5]
    return out


@inlined
def _half_squares(residuals: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Half the sum of squares (N,) of residuals (N, K) in units of their sigmas (K,)."""
    out = np.empty(len(residuals))
    for i in range(len(residuals)):
        square = 0.0
        for j in range(len(sigmas)):
            scaled = residuals[i, j] / sigmas[j]
            square += scaled * scaled
        out[i] = 0.5 * square
    return out


@compiled(f"{VECTOR}({MATRIX}, {VECTOR}, {MATRIX}, {MATRIX})")
def misfits(particles: FloatArray, arm: FloatArray, ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Negative logarithm of the likelihood of independent Gaussian errors, but for a constant.

    Args:
        particles: (N, 3 or more) pose in the first columns, map frame.
        arm: (3,) tag antenna in the body frame [m].
        ranges: (M, 4); one of infinite sigma does not count.
        landmarks: (L, 6), likewise.

    Returns:
        (N,).

    Source: huang2024 Eq. (26), its logarithm.
    """
    return _half_squares(residuals(particles, arm, ranges, landmarks), _sigmas(ranges, landmarks))


@compiled(f"Tuple(({VECTOR}, {VECTOR}))({MATRIX}, {VECTOR}, {MATRIX}, float64)")
def gated_misfits(
    particles: FloatArray, weights: FloatArray, landmarks: FloatArray, gate: float
) -> tuple[FloatArray, FloatArray]:
    """As `misfits`, of the landmarks that pass their gate; the sigmas of the others become infinite.

    The cloud's residuals are taken for Gaussian: an accepted one corrects the expectation of the others by
    their covariance, as a Kalman filter's sequential update would.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        landmarks: (L, 6), sigmas are changed in place; range and bearing pass together or not at all.
        gate: greatest NIS that passes.

    Returns:
        NIS (2 L,), each after the measurements before it; misfits (N,).
    """
    no_ranges = np.empty((0, 4))
    values = residuals(particles, np.zeros(3), no_ranges, landmarks)
    mean, cov = _moments(values, weights)
    sigmas = _sigmas(no_ranges, landmarks)
    nis = np.empty(len(mean))
    for j in range(len(mean)):
        cov[j, j] += sigmas[j] * sigmas[j]
        nis[j] = mean[j] * mean[j] / cov[j, j]
        if nis[j] <= gate:
            for k in range(j + 1, len(mean)):
                gain = cov[k, j] / cov[j, j]
                mean[k] -= gain * mean[j]
                for m in range(j + 1, k + 1):
                    cov[k, m] -= gain * cov[m, j]
    for j in range(len(landmarks)):
        if not (nis[2 * j] <= gate and nis[2 * j + 1] <= gate):
            landmarks[j, 4] = landmarks[j, 5] = np.inf
    return nis, _half_squares(values, _sigmas(no_ranges, landmarks))


@inlined
def normalised(logarithms: FloatArray, weights: FloatArray) -> float:
    """Fill in weights (N,) that sum to one from logarithms (N,); returns the effective sample size."""
    greatest = logarithms.max()
    total = 0.0
    total_square = 0.0
    for i in range(len(weights)):
        weights[i] = exp(logarithms[i] - greatest)
        total += weights[i]
        total_square += weights[i] * weights[i]
    weights /= total
    return total * total / total_square


@compiled(f"float64({VECTOR}, {VECTOR}, float64, float64)")
def temper(weights: FloatArray, misfits: FloatArray, most: float, effective: float) -> float:
    """Multiply weights by the greatest power of a likelihood that leaves enough of them, in place.

    Args:
        weights: (N,) that sum to one, before and after.
        misfits: (N,) negative logarithm of the likelihood.
        most: greatest power that is asked for.
        effective: sample size that shall be left.

    Returns:
        The power: `most`, or less, though never less than 0.01.

    Source: weights huang2024 Eq. (28); power: Musso, Oudjane and Le Gland, in Sequential Monte Carlo Methods
    in Practice, 2001, 12.4.
    """
    logarithms = np.log(weights)
    if normalised(logarithms - most * misfits, weights) >= effective:
        return most
    low, high = 0.0, most
    for _ in range(10):
        power = 0.5 * (low + high)
        if normalised(logarithms - power * misfits, weights) >= effective:
            low = power
        else:
            high = power
    power = min(most, max(low, 0.01))
    normalised(logarithms - power * misfits, weights)
    return power
