"""Scans of a robot that swings round at 3 rad/s, with a gyroscope and without."""

from dataclasses import dataclass

import numpy as np
import pytest

from estimators.geometry import wrap_angle
from estimators.lidar.known_motion import GyroTrack
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, ImuSample, PoseIncrement
from tests.estimators.lidar.room_scans import ROOM, scan_while_moving

SAMPLE_NS = 10_000_000
BIAS, NOISE = 0.01, 0.01
"""Of the gyroscope [rad/s]."""


@dataclass(frozen=True, slots=True)
class Swing:
    """A round through the room, from rest on swinging to both sides with up to 3 rad/s, twice a second."""

    def poses(self, times: FloatArray) -> FloatArray:
        """Poses in the map at `times` [s], (N, 3)."""
        yaw = 3.0 / (4.0 * np.pi) * np.sin(4.0 * np.pi * times) * (1.0 - np.exp(-times))
        return np.column_stack([2.0 + np.cos(0.3 * times), 1.9 + 0.8 * np.sin(0.3 * times), yaw])


def samples(path: Swing, seconds: float, seed: int) -> list[ImuSample]:
    rng = np.random.default_rng(seed)
    stamps_ns = SAMPLE_NS * np.arange(round(seconds * 1e9 / SAMPLE_NS))
    times = (stamps_ns * 1e-9).astype(np.float64)
    ahead, behind = path.poses(times + 1e-4)[:, 2], path.poses(times - 1e-4)[:, 2]
    rates = (ahead - behind) / 2e-4 + BIAS + NOISE * rng.standard_normal(len(times))
    return [
        ImuSample(int(at), np.array([0.0, 0.0, rate]), np.zeros(3))
        for at, rate in zip(stamps_ns, rates, strict=True)
    ]


def increments(gyro: list[ImuSample], period: float, seconds: float) -> list[PoseIncrement]:
    matcher = ScanMatcher(ScanMatcher.Config(gyro_sigma=0.03), np.zeros(3))
    path, rng = Swing(), np.random.default_rng(1)
    found, waiting = [], list(gyro)
    for k in range(round(seconds / period)):
        scan = scan_while_moving(ROOM, path, k * period, rng, 0.015, period=period)  # type: ignore[arg-type]
        while waiting and waiting[0].stamp_ns <= scan.end_stamp_ns:
            matcher.update(waiting.pop(0))
        found.append(matcher.update(scan))
    return [m for m in found if m is not None and m.from_stamp_ns < m.stamp_ns]


def errors(found: list[PoseIncrement]) -> tuple[FloatArray, float]:
    """Errors (K, 3) and their mean squared Mahalanobis distance."""
    off, squares = [], []
    for m in found:
        a, b = Swing().poses(np.array([m.from_stamp_ns, m.stamp_ns]) * 1e-9)
        step = complex(*(b - a)[:2]) * np.exp(-1j * a[2])
        error = m.increment - np.array([step.real, step.imag, b[2] - a[2]])
        error[2] = wrap_angle(error[2])
        off.append(error)
        squares.append(error @ np.linalg.solve(m.cov, error))
    return np.array(off), float(np.mean(squares))


@pytest.mark.parametrize(("period", "better"), [(0.1, 0.6), (0.2, 0.6)])
def test_a_gyroscope_deskews_a_swinging_robot(period: float, better: float) -> None:
    with_it, nees = errors(increments(samples(Swing(), 12.0, seed=2), period, 12.0))
    without, blind_nees = errors(increments([], period, 12.0))
    yaw, blind_yaw = (np.sqrt((e[:, 2] ** 2).mean()) for e in (with_it, without))
    assert yaw < better * blind_yaw
    assert nees < blind_nees
    assert np.hypot(*with_it[:, :2].T).max() < np.hypot(*without[:, :2].T).max()


def test_gaps_and_bad_samples_of_a_gyroscope_cost_no_scan() -> None:
    good = samples(Swing(), 5.0, seed=3)
    bad = [ImuSample(m.stamp_ns + 1, np.full(3, np.nan), np.zeros(3)) for m in good[::7]]
    holed = sorted([*(m for m in good if not 1.5e9 < m.stamp_ns < 3.2e9), *bad], key=lambda m: m.stamp_ns)
    found = increments(holed, 0.1, 5.0)
    assert len(found) == len(increments([], 0.1, 5.0))
    assert np.abs(errors(found)[0][:, :2]).max() < 0.05


def test_turns_are_integrals_of_the_rate() -> None:
    track = GyroTrack()
    for k in range(101):
        track.add(ImuSample(k * SAMPLE_NS, np.array([0.0, 0.0, 0.02 * k]), np.zeros(3)))
    # Rate 2 t up to 1 s, where it stays 2: the turn is t^2.
    times = np.array([-1.0, -0.5, 0.0])
    np.testing.assert_allclose(track.turns(10**9, times), [-1.0, -0.75, 0.0], atol=1e-9)
    np.testing.assert_allclose(track.turns(1_050_000_000, np.array([-0.05, -0.55])), [-0.1, -0.85], atol=1e-9)
    assert track.rate() == 2.0
    assert track.covers(0, 1_050_000_000)
    assert not track.covers(0, 1_060_000_000)
    track.add(ImuSample(2 * 10**9, np.zeros(3), np.zeros(3)))
    assert not track.covers(10**9, 2 * 10**9)
