"""What is left of a scan, and where its points are put."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import Attitude, FloatArray, Scan

ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def scan_of(ranges: FloatArray) -> Scan:
    return Scan(0, ANGLES, ranges, np.linspace(0.0, 0.1, len(ANGLES)), np.zeros(len(ANGLES)))


def preparation(**settings: float) -> ScanPreparation:
    return ScanPreparation(ScanPreparation.Config.model_validate(settings), np.zeros(3))


def test_returns_outside_the_limits_are_left_out() -> None:
    ranges = np.full(360, 3.0)
    ranges[:4] = [0.2, 0.5, 8.0, 8.1]
    prepared = preparation(min_range=0.5, max_range=8.0).prepare(scan_of(ranges))
    assert len(prepared.points) == 358
    assert np.hypot(*prepared.points[:2].T) == pytest.approx([0.5, 8.0])


@pytest.mark.parametrize(("most", "left"), [(360, 360), (359, 180), (100, 90)])
def test_a_scan_with_too_many_returns_is_thinned_evenly(most: int, left: int) -> None:
    prepared = preparation(max_points=most).prepare(scan_of(np.full(360, 3.0)))
    assert len(prepared.points) == left
    assert np.ptp(np.diff(prepared.times)) < 1e-12


def test_points_come_with_the_lever_arm_and_with_times_before_the_last_beam() -> None:
    mounting = np.array([0.2, -0.1, np.pi / 2])
    prepared = ScanPreparation(ScanPreparation.Config(), mounting).prepare(scan_of(np.full(360, 3.0)))
    assert prepared.points[180] == pytest.approx([0.2, 2.9])
    assert prepared.times[0] == pytest.approx(-0.1)
    assert prepared.times[-1] == 0.0


@pytest.mark.parametrize(("roll", "pitch"), [(0.1, 0.0), (0.0, -0.15), (0.08, 0.12)])
def test_a_tilted_scan_is_brought_to_the_horizontal(roll: float, pitch: float) -> None:
    # Beams of a tilted scanner in a square room of vertical walls, whatever its heading is.
    R = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()
    directions = np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(360)]) @ R.T
    ranges = 1.5 / np.abs(directions[:, :2]).max(axis=1)
    attitude = Rotation.from_euler("ZYX", [1.1, pitch, roll]).as_quat(scalar_first=True)
    levelling, plain = preparation(level=True), preparation()
    for part in (levelling, plain):
        part.observe(Attitude(0, attitude))
    level = levelling.prepare(scan_of(ranges)).points
    np.testing.assert_allclose(np.abs(level).max(axis=1), 1.5, atol=1e-9)
    assert np.abs(np.abs(plain.prepare(scan_of(ranges)).points).max(axis=1) - 1.5).max() > 0.003


def test_what_a_tilted_scanner_sees_far_above_or_below_itself_is_left_out() -> None:
    attitude = Rotation.from_euler("Y", 0.2).as_quat(scalar_first=True)
    part = preparation(level=True, max_rise=0.3)
    part.observe(Attitude(0, attitude))
    points = part.prepare(scan_of(np.full(360, 3.0))).points
    assert 0 < len(points) < 200
    assert np.abs(points[:, 0]).max() < 0.3 / np.tan(0.2) + 1e-6


@pytest.mark.parametrize("quat", [[np.nan, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [9.0, 0.0, 0.0, 0.0]])
def test_an_attitude_that_is_none_or_old_levels_nothing(quat: list[float]) -> None:
    scan = scan_of(np.full(360, 3.0))
    expected = preparation().prepare(scan).points
    bad = preparation(level=True)
    bad.observe(Attitude(0, np.array(quat)))
    np.testing.assert_array_equal(bad.prepare(scan).points, expected)
    old = preparation(level=True)
    old.observe(Attitude(0, Rotation.from_euler("Y", 0.2).as_quat(scalar_first=True)))
    late = replace(scan, stamp_ns=10**9)
    np.testing.assert_array_equal(old.prepare(late).points, expected)


@pytest.mark.parametrize(("distance", "between"), [(0.3, 4), (1.5, 1), (8.0, 1)])
def test_of_near_returns_those_are_told_that_are_a_spacing_apart(distance: float, between: int) -> None:
    # Beams are 1 deg apart: 5 mm at 0.3 m. Noise of the ranges, larger than that, changes nothing.
    noisy = distance + np.random.default_rng(0).normal(0.0, 0.015, 360)
    prepared = preparation(spacing=0.02).prepare(scan_of(noisy))
    assert len(prepared.points) == 360
    assert prepared.apart.sum() == pytest.approx(360 / between, rel=0.08)
    assert preparation(spacing=0.0).prepare(scan_of(noisy)).apart.all()


def test_a_scan_has_columns_of_one_length() -> None:
    column = np.zeros(3)
    with pytest.raises(ValueError, match="not equally long"):
        Scan(0, column, column[:2], column, column)
