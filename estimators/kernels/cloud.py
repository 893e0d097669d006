"""The cloud of particles: its noise, its moments, and how its particles are moved and resampled."""

from math import sqrt

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, solve_upper, weighted_product, wrapped
from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray, IntArray

LEAST_VARIANCE = 1e-12
"""Of a cloud that is a single point [m^2, rad^2], so that its covariance can be inverted."""
_YAWS = (2, 8)
"""Columns that are angles."""


@compiled(f"void({MATRIX}, {MATRIX}, {VECTOR})")
def match(noise: FloatArray, particles: FloatArray, weights: FloatArray) -> None:
    """Give noise exactly the moments that it has on average, in place.

    Its weighted mean becomes zero, its covariance the identity, its covariance with the poses
    zero. Few particles would otherwise take the chance correlations of their noise for true ones. Where too
    few particles have any weight, noise stays as it is.

    Args:
        noise: (N, 3) standard normal.
        particles: (N, 9).
        weights: (N,) that sum to one.

    Source: Pham, Monthly Weather Review 129, 2001, second-order exact sampling; by Gram-Schmidt here.
    """
    count = len(noise)
    basis = np.ones((7, count))
    for i in range(count):
        for j in range(3):
            deviation = particles[i, j] - particles[0, j]
            basis[1 + j, i] = wrapped(deviation) if j == 2 else deviation
            basis[4 + j, i] = noise[i, j]
    for k in range(7):
        row = basis[k]
        before = weighted_product(row, row, weights)
        for j in range(k):
            row -= weighted_product(basis[j], row, weights) * basis[j]
        square = weighted_product(row, row, weights)
        if square > 1e-6 * before:
            row /= sqrt(square)
        elif k < 4:
            row[:] = 0.0
        else:
            return
    for i in range(count):
        for j in range(3):
            noise[i, j] = basis[4 + j, i]


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({MATRIX}, {VECTOR}, int64)")
def moments(particles: FloatArray, weights: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Mean (columns,) and covariance (columns, columns) of the first columns of weighted particles.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        columns: 3 for the pose, 6 with velocity, 9 for all.
    """
    # Angles are averaged as differences from one of them, the heaviest.
    reference = particles[weights.argmax()]
    mean, cov = np.zeros(columns), np.zeros((columns, columns))
    deviations = np.empty((len(particles), columns))
    for i in range(len(particles)):
        for j in range(columns):
            deviation = particles[i, j] - reference[j]
            deviations[i, j] = wrapped(deviation) if j in _YAWS else deviation
            mean[j] += weights[i] * deviations[i, j]
    for i in range(len(particles)):
        for j in range(columns):
            deviations[i, j] -= mean[j]
            for k in range(j + 1):
                cov[j, k] += weights[i] * deviations[i, j] * deviations[i, k]
    for j in range(columns):
        mean[j] += reference[j]
        if j in _YAWS:
            mean[j] = wrapped(mean[j])
        for k in range(j):
            cov[k, j] = cov[j, k]
    return mean, cov


@compiled(f"Tuple(({VECTOR}, {MATRIX}, {MATRIX}))({MATRIX}, {VECTOR})")
def pose_law(particles: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The cloud as a Gaussian of the pose, and how all else hangs together with the pose.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.

    Returns:
        Mean (3,), lower Cholesky factor (3, 3) of the covariance, regression (6, 3) of the other columns.
    """
    mean, cov = moments(particles, weights, 9)
    pose, pose_cov = np.empty(3), np.empty((3, 3))
    for j in range(3):
        pose[j] = mean[j]
        for k in range(3):
            pose_cov[j, k] = cov[j, k]
        pose_cov[j, j] += 1e-9 * cov[j, j] + LEAST_VARIANCE
    factor = cholesky(pose_cov)
    gain, along = np.empty((6, 3)), np.empty(3)
    for j in range(6):
        for k in range(3):
            along[k] = cov[3 + j, k]
        along = solve_upper(factor, solve_lower(factor, along))
        for k in range(3):
            gain[j, k] = along[k]
    return pose, factor, gain


@compiled(f"void({MATRIX}, {MATRIX}, {MATRIX})")
def put(particles: FloatArray, poses: FloatArray, gain: FloatArray) -> None:
    """Move particles to new poses, and all else in them as far as it hangs together with the pose, in place.

    Args:
        particles: (N, 9).
        poses: (N, 3) x [m], y [m], yaw [rad], map frame.
        gain: (6, 3) regression of the other columns on the pose.
    """
    for i in range(len(particles)):
        particle = particles[i]
        dx, dy = poses[i, 0] - particle[0], poses[i, 1] - particle[1]
        turn = wrapped(poses[i, 2] - particle[2])
        for j in range(6):
            particle[3 + j] += gain[j, 0] * dx + gain[j, 1] * dy + gain[j, 2] * turn
        particle[0] = poses[i, 0]
        particle[1] = poses[i, 1]
        for j in _YAWS:
            particle[j] = wrapped(poses[i, 2] if j == 2 else particle[j])


@compiled(f"{MATRIX}({MATRIX}, {VECTOR}, int64[::1], {MATRIX}, float64)")
def resampled(
    particles: FloatArray, weights: FloatArray, kept: IntArray, noise: FloatArray, width: float
) -> FloatArray:
    """Particles to go on with at equal weights, spread by a Gaussian kernel.

    They are drawn together first, so that the cloud keeps its mean and covariance.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        kept: (N,) indices of those that are kept.
        noise: (N, 3) standard normal.
        width: of the kernel, in standard deviations of the cloud, at most 1.

    Returns:
        (N, 9).

    Source: Liu and West, in Sequential Monte Carlo Methods in Practice, 2001, 10.3.
    """
    mean, factor, gain = pose_law(particles, weights)
    chosen = particles[kept]
    match(noise, chosen, np.full(len(kept), 1.0 / len(kept)))
    together = sqrt(1.0 - width * width)
    poses = np.empty((len(kept), 3))
    for i in range(len(kept)):
        for j in range(3):
            deviation = chosen[i, j] - mean[j]
            if j == 2:
                deviation = wrapped(deviation)
            poses[i, j] = mean[j] + together * deviation
            for k in range(j + 1):
                poses[i, j] += width * factor[j, k] * noise[i, k]
    put(chosen, poses, gain)
    return chosen
