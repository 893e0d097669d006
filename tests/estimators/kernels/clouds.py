"""Random clouds of particles, headings next to half a turn, and measurements for the kernels."""

import numpy as np

from estimators.messages import FloatArray

ARM = np.array([0.15, -0.1, 0.3])
RANGES = np.array([[-4.0, 1.0, 5.2, 0.1], [6.0, 5.0, 7.9, 0.08], [2.0, -7.0, 7.1, 0.12]])
LANDMARKS = np.array([[1.0, 4.0, 4.1, -1.6, 0.05, 0.02], [5.0, 1.0, 5.0, 3.05, 0.04, 0.015]])


def wrapped(angles: FloatArray) -> FloatArray:
    """Angles within half a turn, by complex numbers."""
    return np.asarray(np.angle(np.exp(1j * angles)))


def random_cloud(seed: int, count: int = 60) -> tuple[FloatArray, FloatArray]:
    """Particles (N, 9), all columns correlated, and uneven weights (N,)."""
    rng = np.random.default_rng(seed)
    mixing = 0.1 * rng.normal(size=(9, 9))
    mean = np.array([0.3, 0.2, 3.1, 0.4, -0.2, 0.3, 0.1, 0.3, -3.1])
    particles = mean + rng.normal(size=(count, 9)) @ mixing
    particles[:, [2, 8]] = wrapped(particles[:, [2, 8]])
    weights = rng.exponential(size=count)
    return particles, weights / weights.sum()


def deviations(particles: FloatArray, centre: FloatArray) -> FloatArray:
    """Differences of particles (N, 9) from one, angles wrapped."""
    out: FloatArray = particles - centre
    out[:, [2, 8]] = wrapped(out[:, [2, 8]])
    return out


def law(particles: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (9,) and covariance (9, 9), angles averaged as differences from the first particle."""
    mean = particles[0] + weights @ deviations(particles, particles[0])
    mean[[2, 8]] = wrapped(mean[[2, 8]])
    centred = deviations(particles, mean)
    return mean, (weights[:, None] * centred).T @ centred


def predicted(poses: FloatArray, ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Measured minus predicted (N, M + 2 L), in complex numbers."""
    at = poses[:, 0] + 1j * poses[:, 1]
    turn = np.exp(1j * poses[:, 2])
    tags = at + turn * complex(ARM[0], ARM[1])
    columns = [row[2] - np.abs(tags - complex(row[0], row[1])) for row in ranges]
    for row in landmarks:
        seen = (complex(row[0], row[1]) - at) / turn
        columns += [row[2] - np.abs(seen), wrapped(row[3] - np.angle(seen))]
    return np.column_stack(columns)


def sigmas(ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Standard deviations in the order of the residuals."""
    return np.concatenate([ranges[:, 3], landmarks[:, 4:].ravel()])
