"""How particles move: with constant velocity, and what odometry's increments say of it."""

from math import cos, sin, sqrt

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, solve_upper, wrapped
from estimators.kernels.cloud import match
from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray


@compiled(f"void({MATRIX}, {VECTOR}, {MATRIX}, float64, float64, float64)")
def move(
    particles: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
    dt: float,
    accel_noise: float,
    yaw_accel_noise: float,
) -> None:
    """Move particles by their velocities and white acceleration, in place.

    What it adds to position and velocity has the right variances, but is wholly correlated.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        noise: (N, 3) standard normal; is given the moments that it should have.
        dt: time step [s].
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 6.2.2.
    """
    match(noise, particles, weights)
    for i in range(len(particles)):
        particle = particles[i]
        for j in range(3):
            change = (yaw_accel_noise if j == 2 else accel_noise) * sqrt(dt) * noise[i, j]
            particle[j] += (particle[3 + j] + change / sqrt(3.0)) * dt
            particle[3 + j] += change
        particle[2] = wrapped(particle[2])


@compiled(f"float64({MATRIX}, {VECTOR}, {MATRIX}, {VECTOR}, {MATRIX}, float64)")
def take_increment(
    particles: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
    increment: FloatArray,
    cov: FloatArray,
    gate: float,
) -> float:
    """Correct every particle's motion since the keyframe by an increment that passes its gate, in place.

    In the keyframe's frame, a particle's motion and velocity m are corrected as by an ensemble Kalman filter,
    by the increment z with noise e of its own: ``m += Cov(m, h) (Cov(h, h) + R)^-1 (z + e - h)``, where h is
    the motion alone. Keyframes are left alone: motion says nothing of them, and what few particles' chance
    correlations say would wear out the doubt about the heading.

    Args:
        particles: (N, 9).
        weights: (N,) that sum to one.
        noise: (N, 3) standard normal; is given the moments that it should have.
        increment: (3,) since the keyframe, in the keyframe's body frame.
        cov: (3, 3) of the increment.
        gate: greatest NIS that passes.

    Returns:
        Normalised innovation squared.

    Source: Burgers, van Leeuwen and Evensen, Monthly Weather Review 126, 1998.
    """
    count = len(particles)
    # Prediction minus measurement, then velocity, both in the keyframe's frame.
    motion = np.empty((count, 6))
    mean, joint = np.zeros(6), np.zeros((6, 3))
    for i in range(count):
        particle = particles[i]
        c, s = cos(particle[8]), sin(particle[8])
        dx, dy = particle[0] - particle[6], particle[1] - particle[7]
        motion[i, 0] = c * dx + s * dy - increment[0]
        motion[i, 1] = c * dy - s * dx - increment[1]
        motion[i, 2] = wrapped(particle[2] - particle[8] - increment[2])
        motion[i, 3] = c * particle[3] + s * particle[4]
        motion[i, 4] = c * particle[4] - s * particle[3]
        motion[i, 5] = particle[5]
        for j in range(6):
            mean[j] += weights[i] * motion[i, j]
    for i in range(count):
        for j in range(6):
            for k in range(3):
                joint[j, k] += weights[i] * (motion[i, j] - mean[j]) * (motion[i, k] - mean[k])
    root, S_root = cholesky(cov), cholesky(joint[:3] + cov)
    scaled = solve_lower(S_root, mean[:3])
    nis = scaled[0] ** 2 + scaled[1] ** 2 + scaled[2] ** 2
    if not nis <= gate:
        return float(nis)
    match(noise, particles, weights)
    innovation = np.empty(3)
    for i in range(count):
        particle = particles[i]
        for j in range(3):
            innovation[j] = -motion[i, j]
            for k in range(j + 1):
                innovation[j] += root[j, k] * noise[i, k]
        along = solve_upper(S_root, solve_lower(S_root, innovation))
        for j in range(6):
            for k in range(3):
                motion[i, j] += joint[j, k] * along[k]
        c, s = cos(particle[8]), sin(particle[8])
        forward, left = motion[i, 0] + increment[0], motion[i, 1] + increment[1]
        particle[0] = particle[6] + c * forward - s * left
        particle[1] = particle[7] + s * forward + c * left
        particle[2] = wrapped(particle[8] + motion[i, 2] + increment[2])
        particle[3] = c * motion[i, 3] - s * motion[i, 4]
        particle[4] = s * motion[i, 3] + c * motion[i, 4]
        particle[5] = motion[i, 5]
    return float(nis)


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({VECTOR}, {MATRIX}, float64, float64, float64)")
def predicted(
    mean: FloatArray, cov: FloatArray, dt: float, accel_noise: float, yaw_accel_noise: float
) -> tuple[FloatArray, FloatArray]:
    """A state after a time step with constant velocity and white acceleration.

    Args:
        mean: (N,) pose, velocity along the map's axes, anything that does not move.
        cov: (N, N) of the same.
        dt: time step [s]; negative steps look back, their noise is that of the positive step.
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Returns:
        Mean (N,) and covariance (N, N), symmetric.

    Source: `models.motion.constant_velocity`, F m and F P F^T + Q.
    """
    count, step = len(mean), abs(dt)
    mean, moved = mean.copy(), cov.copy()
    for i in range(3):
        mean[i] += dt * mean[3 + i]
        for j in range(count):
            moved[i, j] += dt * moved[3 + i, j]
    for i in range(count):
        for j in range(3):
            moved[i, j] += dt * moved[i, 3 + j]
    for i in range(3):
        density = yaw_accel_noise if i == 2 else accel_noise
        power = density * density
        moved[i, i] += power * step**3 / 3.0
        moved[i, 3 + i] += power * step * dt / 2.0
        moved[3 + i, i] += power * step * dt / 2.0
        moved[3 + i, 3 + i] += power * step
    return mean, 0.5 * (moved + moved.T)


@compiled(f"float64({VECTOR}, {VECTOR}, {MATRIX}, {VECTOR}, {MATRIX})")
def increment_nis(
    reference: FloatArray, pose: FloatArray, cov: FloatArray, increment: FloatArray, increment_cov: FloatArray
) -> float:
    """Normalised innovation squared of an increment between two poses.

    Args:
        reference: (3,) pose where it begins, map frame.
        pose: (3,) pose where it ends, map frame.
        cov: (9, 9) of this pose, its velocity and the reference.
        increment: (3,) measured, in the body frame of the reference.
        increment_cov: (3, 3) of the same.

    Source: model: `models.motion.increment`.
    """
    c, s = cos(reference[2]), sin(reference[2])
    dx, dy = pose[0] - reference[0], pose[1] - reference[1]
    ahead, left = c * dx + s * dy, c * dy - s * dx
    by_pose = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    H = np.zeros((3, 9))
    H[:, :3], H[:, 6:] = by_pose, -by_pose
    H[0, 8], H[1, 8] = left, -ahead
    turn = wrapped(increment[2] - wrapped(pose[2] - reference[2]))
    residual = np.array([increment[0] - ahead, increment[1] - left, turn])
    root = cholesky(H @ cov @ H.T + increment_cov)
    scaled = solve_lower(root, residual)
    return float(scaled[0] ** 2 + scaled[1] ** 2 + scaled[2] ** 2)
