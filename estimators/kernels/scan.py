"""Scans held against particles."""

from math import cos, exp, log, sin

import numpy as np

from estimators.kernels.compilation import MATRIX, VECTOR, compiled, inlined
from estimators.messages import FloatArray


@inlined
def _distance(x: float, y: float, distances: FloatArray, resolution: float, origin: FloatArray) -> float:
    """Distance [m] at (x, y), between the four nearest cells; infinite outside the grid."""
    column, row = (x - origin[0]) / resolution, (y - origin[1]) / resolution
    if not (0.0 <= column <= distances.shape[1] - 1 and 0.0 <= row <= distances.shape[0] - 1):
        return np.inf
    i, j = min(int(row), distances.shape[0] - 2), min(int(column), distances.shape[1] - 2)
    v, u = row - i, column - j
    lower = (1.0 - u) * distances[i, j] + u * distances[i, j + 1]
    upper = (1.0 - u) * distances[i + 1, j] + u * distances[i + 1, j + 1]
    return float((1.0 - v) * lower + v * upper)


@compiled(f"{VECTOR}({MATRIX}, {MATRIX}, {VECTOR}, {MATRIX}, float64, {VECTOR}, float64, float64)")
def scan_misfits(
    particles: FloatArray,
    beams: FloatArray,
    lidar_in_body: FloatArray,
    distances: FloatArray,
    resolution: float,
    origin: FloatArray,
    sigma: float,
    strays: float,
) -> FloatArray:
    """Negative logarithm of the likelihood of beams that end on obstacles, or anywhere.

    Every beam is seen from where a particle was when it was measured, by the particle's velocity.

    Args:
        particles: (N, 9).
        beams: (B, 3) direction [rad], lidar frame; range [m]; how long before the particles' time [s].
        lidar_in_body: (3,) x [m], y [m], yaw [rad] of the LiDAR, body frame.
        distances: (rows, columns) to the nearest obstacle [m], rows along y, at least 2 of each.
        resolution: of the grid [m].
        origin: (2,) centre of the first cell, map frame [m].
        sigma: standard deviation of that distance where a beam ends [m].
        strays: share of beams that may end anywhere.

    Returns:
        (N,).

    Source: Thrun, Burgard and Fox, Probabilistic Robotics, 6.4, likelihood fields.
    """
    out = np.zeros(len(particles))
    for i in range(len(particles)):
        particle = particles[i]
        for k in range(len(beams)):
            angle, distance, age = beams[k, 0], beams[k, 1], beams[k, 2]
            yaw = particle[2] - age * particle[5]
            c, s = cos(yaw), sin(yaw)
            u, v = cos(lidar_in_body[2] + angle), sin(lidar_in_body[2] + angle)
            forward, left = lidar_in_body[0] + distance * u, lidar_in_body[1] + distance * v
            x = particle[0] - age * particle[3] + c * forward - s * left
            y = particle[1] - age * particle[4] + s * forward + c * left
            scaled = _distance(x, y, distances, resolution, origin) / sigma
            out[i] -= log((1.0 - strays) * exp(-0.5 * scaled * scaled) + strays)
    return out
