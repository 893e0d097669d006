"""Scan misfits against plain NumPy and scipy's interpolation."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from estimators.kernels.scan import scan_misfits
from tests.estimators.kernels.clouds import random_cloud

SIGMA, STRAYS, RESOLUTION = 0.05, 0.1, 0.2


@pytest.mark.parametrize("seed", range(3))
def test_misfits_are_those_of_scipys_interpolation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    particles, _ = random_cloud(seed)
    beams = np.column_stack(
        [rng.uniform(-3.0, 3.0, 30), rng.uniform(0.5, 6.0, 30), rng.uniform(0.0, 0.1, 30)]
    )
    mounting = np.array([0.2, -0.1, 0.7])
    distances = rng.uniform(0.0, 0.3, (40, 50))
    origin = np.array([-5.0, -3.9])
    grid = RegularGridInterpolator(
        (origin[1] + RESOLUTION * np.arange(40), origin[0] + RESOLUTION * np.arange(50)),
        distances,
        bounds_error=False,
        fill_value=np.inf,
    )
    expected = np.zeros(len(particles))
    outside = 0
    for angle, distance, age in beams:
        x, y, yaw = (particles[:, :3] - age * particles[:, 3:6]).T
        in_body = complex(mounting[0], mounting[1]) + distance * np.exp(1j * (mounting[2] + angle))
        ends = x + 1j * y + np.exp(1j * yaw) * in_body
        scaled = grid(np.column_stack([ends.imag, ends.real])) / SIGMA
        outside += int(np.isinf(scaled).sum())
        expected -= np.log((1.0 - STRAYS) * np.exp(-0.5 * scaled**2) + STRAYS)
    found = scan_misfits(particles, beams, mounting, distances, RESOLUTION, origin, SIGMA, STRAYS)
    assert outside > 0
    np.testing.assert_allclose(found, expected, rtol=1e-9)
