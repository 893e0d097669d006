"""What is known of the motion without scans: odometry from outside, or a gyroscope's yaw rates.

A matcher that knows the motion takes every beam to where the body is at the scan's end, and looks for what
the known motion errs by: that is small and slow, so scans may be rare and the robot may sway.
"""

from collections import deque

import numpy as np

from estimators.geometry import compose, exponential, logarithm, rotation, wrap_angle
from estimators.lidar.keyframes import is_covariance
from estimators.messages import FloatArray, ImuSample, PoseIncrement
from estimators.models.motion import chained, constant_velocity

KEPT_NS = 5_000_000_000
"""Motion that is longer ago is forgotten."""
LONGEST_GUESS_NS = 250_000_000
"""The newest speed is taken to last so long at most."""
LONGEST_GYRO_GAP_NS = 50_000_000
"""So long a turn is known between two yaw rates, and after the newest: a robot that swings does so fast."""


class OdometryTrack:
    """Increments of an odometry that is not ours, chained.

    Args:
        accel_noise: densities of white acceleration [m/s^2/sqrt(Hz)] and angular acceleration
            [rad/s^2/sqrt(Hz)], by which a guess beyond the newest increment errs.
    """

    def __init__(self, accel_noise: tuple[float, float]) -> None:
        self._accel_noise = accel_noise
        self._poses: deque[tuple[int, FloatArray]] = deque()
        self._steps: deque[PoseIncrement] = deque()

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest increment; None without any."""
        return self._poses[-1][0] if self._poses else None

    def add(self, measured: PoseIncrement) -> None:
        """Take an increment; one that does not hang on to the newest begins anew, and so does a bad one."""
        is_step = _is_step(measured)
        if not is_step or measured.from_stamp_ns != self.newest_ns:
            self._poses.clear()
            self._steps.clear()
            self._poses.append((measured.from_stamp_ns if is_step else measured.stamp_ns, np.zeros(3)))
            if not is_step:
                return
        pose = self._poses[-1][1]
        yaw = pose[2] + measured.increment[2]
        pose = compose(pose, measured.increment)
        # Not wrapped: headings are interpolated.
        pose[2] = yaw
        self._poses.append((measured.stamp_ns, pose))
        self._steps.append(measured)
        while self._steps[0].stamp_ns < measured.stamp_ns - KEPT_NS:
            self._steps.popleft()
            self._poses.popleft()

    def covers(self, from_ns: int, to_ns: int) -> bool:
        """Whether the motion between two instants is known."""
        return (
            bool(self._steps)
            and self._poses[0][0] <= from_ns <= to_ns <= self._poses[-1][0] + LONGEST_GUESS_NS
        )

    def motion(self, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Motion (3,) between two instants and its covariance (3, 3); None where it is not known.

        A step that is only in part between them counts in part, as a random walk does.
        """
        if not self.covers(from_ns, to_ns):
            return None
        moved, cov = np.zeros(3), np.zeros((3, 3))
        for step in self._steps:
            begin, end = max(step.from_stamp_ns, from_ns), min(step.stamp_ns, to_ns)
            if begin < end:
                share = (end - begin) / (step.stamp_ns - step.from_stamp_ns)
                piece = step.increment if share == 1.0 else exponential(share * logarithm(step.increment))
                moved, cov = chained(moved, cov, piece, share * step.cov)
        newest_ns = self._poses[-1][0]
        if to_ns > newest_ns:
            dt = (to_ns - max(newest_ns, from_ns)) * 1e-9
            _, Q = constant_velocity(dt, *self._accel_noise)
            moved, cov = chained(moved, cov, exponential(dt * self.twist()), Q[:3, :3])
        return moved, cov

    def beams(self, stamp_ns: int, times: FloatArray) -> FloatArray:
        """Poses (N, 3) at times (N,) [s] relative to an instant, seen from where the body is then.

        The track must cover them, as `motion` tells.
        """
        instants = np.array([at for at, _ in self._poses], dtype=np.int64)
        poses = np.array([pose for _, pose in self._poses])
        if instants[-1] < stamp_ns:
            guess = compose(poses[-1], exponential((stamp_ns - instants[-1]) * 1e-9 * self.twist()))
            guess[2] = poses[-1, 2] + wrap_angle(guess[2] - poses[-1, 2])
            instants, poses = np.append(instants, stamp_ns), np.vstack([poses, guess])
        known = (instants - stamp_ns) * 1e-9
        at = np.column_stack([np.interp(times, known, column) for column in poses.T])
        end = np.array([np.interp(0.0, known, column) for column in poses.T])
        back = rotation(-end[2])
        at[:, :2] = (at[:, :2] - end[:2]) @ back.T
        at[:, 2] -= end[2]
        return at

    def twist(self) -> FloatArray:
        """Newest velocity (3,) in the body frame [m/s, rad/s]."""
        step = self._steps[-1]
        return logarithm(step.increment) / ((step.stamp_ns - step.from_stamp_ns) * 1e-9)


def _is_step(measured: PoseIncrement) -> bool:
    return (
        measured.from_stamp_ns < measured.stamp_ns
        and bool(np.isfinite(measured.increment).all())
        and is_covariance(measured.cov)
    )


class GyroTrack:
    """How far the body has turned, by the rates that its gyroscope measured."""

    def __init__(self) -> None:
        self._turned: deque[tuple[int, float, float]] = deque()

    def add(self, sample: ImuSample) -> None:
        """Take a sample; a late one and one that is not finite say nothing."""
        rate, stamp_ns = float(sample.gyro[2]), sample.stamp_ns
        if not np.isfinite(rate) or (self._turned and stamp_ns <= self._turned[-1][0]):
            return
        turned = 0.0
        if self._turned:
            before_ns, before, before_rate = self._turned[-1]
            if stamp_ns - before_ns > LONGEST_GYRO_GAP_NS:
                self._turned.clear()
            else:
                turned = before + 0.5 * (before_rate + rate) * (stamp_ns - before_ns) * 1e-9
        self._turned.append((stamp_ns, turned, rate))
        while self._turned[0][0] < stamp_ns - KEPT_NS:
            self._turned.popleft()

    def covers(self, from_ns: int, to_ns: int) -> bool:
        """Whether the turn between two instants is known."""
        return bool(self._turned) and (
            self._turned[0][0] <= from_ns <= to_ns <= self._turned[-1][0] + LONGEST_GYRO_GAP_NS
        )

    def turns(self, stamp_ns: int, times: FloatArray) -> FloatArray:
        """How far (N,) [rad] the body was turned at times (N,) [s] relative to an instant, against it."""
        instants, turned, rates = np.array(self._turned).T
        known = (instants - stamp_ns) * 1e-9
        if known[-1] < 0.0:
            known, turned = np.append(known, 0.0), np.append(turned, turned[-1] - rates[-1] * known[-1])
        turns: FloatArray = np.interp(times, known, turned) - np.interp(0.0, known, turned)
        return turns

    def rate(self) -> float:
        """Newest yaw rate [rad/s]."""
        return self._turned[-1][2]
