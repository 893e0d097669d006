"""How particles move: with constant velocity, and where odometry's increments lead."""

from math import cos, sin, sqrt

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, wrapped
from estimators.kernels.cloud import match
from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray

_POSE, _KEYFRAME = 0, 6
"""Columns where these begin."""


@compiled(f"void({MATRIX}, {VECTOR}, {MATRIX}, float64, float64, float64)")
def move(
    particles: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
    dt: float,
    accel_noise: float,
    yaw_accel_noise: float,
) -> None:
    """Move particles by their velocities and a random acceleration that is constant for the step, in place.

    Args:
        particles: (N, 12).
        weights: (N,) that sum to one.
        noise: (N, 3) standard normal; is given the moments that it should have.
        dt: time step [s].
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 6.3.2.
    """
    match(noise, particles, weights, _POSE)
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


@compiled(f"float64({MATRIX}, {VECTOR}, {VECTOR}, {MATRIX})")
def increment_nis(
    particles: FloatArray, weights: FloatArray, increment: FloatArray, cov: FloatArray
) -> float:
    """Normalised innovation squared of an increment, the cloud's residuals taken for Gaussian.

    Args:
        particles: (N, 12).
        weights: (N,) that sum to one.
        increment: (3,) since the keyframe, in the keyframe's body frame.
        cov: (3, 3) of the increment.
    """
    residuals = increment_residuals(particles, increment)
    mean, S = np.zeros(3), cov.copy()
    for i in range(len(residuals)):
        for j in range(3):
            mean[j] += weights[i] * residuals[i, j]
    for i in range(len(residuals)):
        for j in range(3):
            for k in range(j + 1):
                S[j, k] += weights[i] * (residuals[i, j] - mean[j]) * (residuals[i, k] - mean[k])
    scaled = solve_lower(cholesky(S), mean)
    return float(scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2])


@compiled(f"{VECTOR}({MATRIX}, {VECTOR}, {MATRIX})")
def increment_misfits(particles: FloatArray, increment: FloatArray, cov: FloatArray) -> FloatArray:
    """Negative logarithm (N,) of how likely particles make an increment, but for a constant.

    Args:
        particles: (N, 12).
        increment: (3,) since the keyframe, in the keyframe's body frame.
        cov: (3, 3) of the increment.
    """
    residuals, root = increment_residuals(particles, increment), cholesky(cov)
    out = np.empty(len(particles))
    for i in range(len(particles)):
        scaled = solve_lower(root, residuals[i])
        out[i] = 0.5 * (scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2])
    return out


@compiled(f"void({MATRIX}, {VECTOR}, {MATRIX}, {VECTOR}, {MATRIX}, float64)")
def follow(
    particles: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
    increment: FloatArray,
    cov: FloatArray,
    dt: float,
) -> None:
    """Put every particle where an increment with noise of its own leads from its keyframe, in place.

    Its velocity becomes that since the last increment.

    Args:
        particles: (N, 12).
        weights: (N,) that sum to one.
        noise: (N, 3) standard normal; is given the moments that it should have.
        increment: (3,) since the keyframe, in the keyframe's body frame.
        cov: (3, 3) of the increment.
        dt: time since the last increment [s]; at 0 velocities are kept.
    """
    match(noise, particles, weights, _KEYFRAME)
    root = cholesky(cov)
    step = np.empty(3)
    for i in range(len(particles)):
        particle = particles[i]
        for j in range(3):
            step[j] = increment[j]
            for k in range(j + 1):
                step[j] += root[j, k] * noise[i, k]
        c, s = cos(particle[8]), sin(particle[8])
        particle[0] = particle[6] + c * step[0] - s * step[1]
        particle[1] = particle[7] + s * step[0] + c * step[1]
        particle[2] = wrapped(particle[8] + step[2])
        if dt > 0.0:
            particle[3] = (particle[0] - particle[9]) / dt
            particle[4] = (particle[1] - particle[10]) / dt
            particle[5] = wrapped(particle[2] - particle[11]) / dt
        particle[9:12] = particle[0:3]
