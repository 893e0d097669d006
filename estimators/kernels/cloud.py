"""The cloud of particles: its motion, its noise and its moments."""

from math import cos, sin, sqrt

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, solve_upper, weighted_product, wrapped
from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray

LEAST_VARIANCE = 1e-12
"""Of a cloud that is a single point [m^2, rad^2], so that its covariance can be inverted."""
_YAWS = (2, 8, 11)
"""Columns that are angles."""


@compiled(f"void({MATRIX}, {MATRIX}, {VECTOR}, int64, int64)")
def match(noise: FloatArray, particles: FloatArray, weights: FloatArray, first: int, last: int) -> None:
    """Give noise exactly the moments that it has on average, in place.

    Its weighted mean becomes zero, its covariance the identity, its covariance with columns of the particles
    zero. Few particles would otherwise take the chance correlations of their noise for true ones. Where there
    are too few for that many columns, noise stays as it is.

    Args:
        noise: (N, 3) standard normal.
        particles: (N, 12).
        weights: (N,) that sum to one.
        first: first column.
        last: the column after the last.

    Source: Pham, Monthly Weather Review 129, 2001, second-order exact sampling; by Gram-Schmidt here.
    """
    count, columns = len(noise), 1 + last - first
    basis = np.ones((columns + 3, count))
    for i in range(count):
        for j in range(first, last):
            deviation = particles[i, j] - particles[0, j]
            basis[1 + j - first, i] = wrapped(deviation) if j in _YAWS else deviation
        for j in range(3):
            basis[columns + j, i] = noise[i, j]
    for k in range(columns + 3):
        row = basis[k]
        before = weighted_product(row, row, weights)
        for j in range(k):
            row -= weighted_product(basis[j], row, weights) * basis[j]
        square = weighted_product(row, row, weights)
        if square > 1e-6 * before:
            row /= sqrt(square)
        elif k < columns:
            row[:] = 0.0
        else:
            return
    for i in range(count):
        for j in range(3):
            noise[i, j] = basis[columns + j, i]


@compiled(f"void({MATRIX}, {MATRIX}, float64, float64, float64)")
def move(
    particles: FloatArray, noise: FloatArray, dt: float, accel_noise: float, yaw_accel_noise: float
) -> None:
    """Move particles by their velocities and a random acceleration that is constant for the step, in place.

    Args:
        particles: (N, 12).
        noise: (N, 3) standard normal.
        dt: time step [s].
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 6.3.2.
    """
    for i in range(len(particles)):
        particle = particles[i]
        for j in range(3):
            change = (yaw_accel_noise if j == 2 else accel_noise) * sqrt(dt) * noise[i, j]
            particle[j] += (particle[3 + j] + 0.5 * change) * dt
            particle[3 + j] += change
        particle[2] = wrapped(particle[2])


@compiled(f"{MATRIX}({MATRIX}, {VECTOR})")
def increment_residuals(particles: FloatArray, increment: FloatArray) -> FloatArray:
    """Measured minus predicted increment of every particle, (N, 3).

    Args:
        particles: (N, 12).
        increment: (3,) since the keyframe, in the keyframe's body frame.
    """
    out = np.empty((len(particles), 3))
    for i in range(len(particles)):
        particle = particles[i]
        c, s = cos(particle[8]), sin(particle[8])
        dx, dy = particle[0] - particle[6], particle[1] - particle[7]
        out[i, 0] = increment[0] - c * dx - s * dy
        out[i, 1] = increment[1] + s * dx - c * dy
        out[i, 2] = wrapped(increment[2] - particle[2] + particle[8])
    return out


@compiled(f"void({MATRIX}, {MATRIX}, float64)")
def follow(particles: FloatArray, increments: FloatArray, dt: float) -> None:
    """Put every particle where its own increment leads from its keyframe, in place.

    Its velocity becomes that since the last increment.

    Args:
        particles: (N, 12).
        increments: (N, 3) in the keyframe's body frame.
        dt: time since the last increment [s]; at 0 velocities are kept.
    """
    for i in range(len(particles)):
        particle, step = particles[i], increments[i]
        c, s = cos(particle[8]), sin(particle[8])
        particle[0] = particle[6] + c * step[0] - s * step[1]
        particle[1] = particle[7] + s * step[0] + c * step[1]
        particle[2] = wrapped(particle[8] + step[2])
        if dt > 0.0:
            particle[3] = (particle[0] - particle[9]) / dt
            particle[4] = (particle[1] - particle[10]) / dt
            particle[5] = wrapped(particle[2] - particle[11]) / dt
        particle[9:12] = particle[0:3]


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({MATRIX}, {VECTOR}, int64)")
def moments(particles: FloatArray, weights: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Mean (columns,) and covariance (columns, columns) of the first columns of weighted particles.

    Args:
        particles: (N, 12).
        weights: (N,) that sum to one.
        columns: 3 for the pose, 6 with velocity, 12 for all.
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
        particles: (N, 12).
        weights: (N,) that sum to one.

    Returns:
        Mean (3,), lower Cholesky factor (3, 3) of the covariance, regression (9, 3) of the other columns.
    """
    mean, cov = moments(particles, weights, 12)
    pose_cov = cov[:3, :3].copy()
    for j in range(3):
        pose_cov[j, j] += 1e-9 * pose_cov[j, j] + LEAST_VARIANCE
    factor = cholesky(pose_cov)
    gain = np.empty((9, 3))
    for j in range(9):
        gain[j] = solve_upper(factor, solve_lower(factor, cov[3 + j, :3]))
    return mean[:3].copy(), factor, gain


@compiled(f"void({MATRIX}, {MATRIX}, {MATRIX})")
def put(particles: FloatArray, poses: FloatArray, gain: FloatArray) -> None:
    """Move particles to new poses, and all else in them as far as it hangs together with the pose, in place.

    Args:
        particles: (N, 12).
        poses: (N, 3) x [m], y [m], yaw [rad], map frame.
        gain: (9, 3) regression of the other columns on the pose.
    """
    for i in range(len(particles)):
        particle = particles[i]
        dx, dy = poses[i, 0] - particle[0], poses[i, 1] - particle[1]
        turn = wrapped(poses[i, 2] - particle[2])
        for j in range(9):
            particle[3 + j] += gain[j, 0] * dx + gain[j, 1] * dy + gain[j, 2] * turn
        particle[0] = poses[i, 0]
        particle[1] = poses[i, 1]
        for j in _YAWS:
            particle[j] = wrapped(poses[i, 2] if j == 2 else particle[j])
