"""What is thought of a scan's motion before it is matched: constant velocity, or what else is known.

With odometry from outside the states are those of its drift: seen from a body that moves as the odometry
says, the robot stands still but for the odometry's error. With a gyroscope this holds of the heading alone.
"""

from dataclasses import dataclass

import numpy as np

from estimators.geometry import compose, rotation, transform_each
from estimators.immutable import immutable
from estimators.kernels.scan_motion import bent, prior_on_states
from estimators.kernels.scan_points import seen_from_end
from estimators.lidar.known_motion import GyroTrack, OdometryTrack
from estimators.lidar.scan_preparation import PreparedScan
from estimators.messages import FloatArray, IntArray
from estimators.models.motion import cubic_between, smooth_motion

_LEAST_VARIANCE = 1e-8
"""Of what odometry says [m^2, rad^2]."""
_WAVES = np.pi * np.arange(1, 7)
"""Wave numbers of a Brownian bridge's modes; what is left out has a seventh of its variance."""
_CLAMPED_WAVES = np.array([4.730040745, 7.853204624, 10.995607838])
"""Of a bar clamped at both ends; what is left out has a hundredth of the variance."""
_CLAMPED_RATIOS = (np.cosh(_CLAMPED_WAVES) - np.cos(_CLAMPED_WAVES)) / (
    np.sinh(_CLAMPED_WAVES) - np.sin(_CLAMPED_WAVES)
)


@immutable
class Expectation:
    """A scan and the states at its ends, before they are told by walls.

    Attributes:
        points: (N, 2) [m] of the beams, moved along the known motion to the end of the scan.
        shares: (N,) of the way in time from the scan before.
        basis: (N, 4) weights of the two poses and velocities in what is left of each beam's pose.
        state: (6,) pose and velocity at the end of the scan before, moved along the known motion.
        cov: (6, 6) of it.
        F: (6, 6) transition from there to the end of this scan.
        Q: (6, 6) its noise.
        twist: (3,) known velocity at the end, body frame; the states' comes on top of it.
        deviation: (3, 3) covariance of what `modes` are multiples of.
        modes: (T, K) how motion between the states deviates from the one that is assumed, at instants that
            are spread evenly over the time from the scan before.
    """

    points: FloatArray
    shares: FloatArray
    basis: FloatArray
    state: FloatArray
    cov: FloatArray
    F: FloatArray
    Q: FloatArray
    twist: FloatArray
    deviation: FloatArray
    modes: FloatArray

    def prior(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Information (12, 12) on the states, the states (12,), and doubt (3,) of the newer pose (sigmas)."""
        return prior_on_states(self.F, self.Q, self.state, self.cov)

    def seen_from_end(self, states: FloatArray) -> FloatArray:
        """All points (N, 2) [m] as the body sees them at the end of the scan, for states (12,)."""
        return seen_from_end(self.points, self.basis, states)

    def bent(self, own: IntArray, rows: FloatArray, index: IntArray) -> FloatArray:
        """Covariance (3, 3) that the pose at the end has because motion between the states bends the scan.

        Args:
            own: (M,) which points are held against lines.
            rows: (M, 6) what `associate` says of them.
            index: (M,) likewise.
        """
        return bent(self.modes, self.shares.take(own), rows, index, self.deviation)


def bridge(shares: FloatArray) -> FloatArray:
    """Modes (M, 6) by which a random walk of unit variance deviates from a straight line."""
    phases: FloatArray = np.outer(shares, _WAVES)
    modes: FloatArray = np.sqrt(2.0) * np.sin(phases) / _WAVES
    return modes


def clamped_bar(shares: FloatArray) -> FloatArray:
    """Modes (M, 3) by which motion under white acceleration deviates from a cubic, of unit power."""
    phases = np.outer(shares, _CLAMPED_WAVES)
    shape = np.cosh(phases) - np.cos(phases) - _CLAMPED_RATIOS * (np.sinh(phases) - np.sin(phases))
    modes: FloatArray = shape / _CLAMPED_WAVES**2
    return modes


# Straight lines between so many instants are off by at most a ten-thousandth of a mode.
_INSTANTS = np.linspace(0.0, 1.0, 1025)
_BRIDGE_MODES, _BAR_MODES = bridge(_INSTANTS), clamped_bar(_INSTANTS)


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """What unknown motion is taken for.

    Attributes:
        accel: density of white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel: of white angular acceleration [rad/s^2/sqrt(Hz)].
        bandwidth: the fastest swaying [Hz].
        gyro_sigma: standard deviation of a yaw rate that is measured [rad/s].
    """

    accel: float
    yaw_accel: float
    bandwidth: float
    gyro_sigma: float


def expect(
    scan: PreparedScan,
    since_ns: int,
    state: FloatArray,
    cov: FloatArray,
    noise: MotionNoise,
    odometry: OdometryTrack,
    gyro: GyroTrack,
) -> Expectation:
    """What is thought of a scan.

    Args:
        scan: that is to be matched.
        since_ns: end of the scan before.
        state: (6,) pose and velocity then.
        cov: (6, 6) of it.
        noise: of what is not known of the motion.
        odometry: used where it reaches from the scan before, or the first beam, to the end.
        gyro: likewise, without odometry.
    """
    dt = (scan.stamp_ns - since_ns) * 1e-9
    shares = 1.0 + scan.times / dt
    first_ns = min(since_ns, scan.stamp_ns + round(float(scan.times[0]) * 1e9))
    moved = odometry.motion(since_ns, scan.stamp_ns) if odometry.covers(first_ns, scan.stamp_ns) else None
    if moved is not None:
        return _along_odometry(scan, shares, state, cov, dt, moved, odometry)
    if gyro.covers(first_ns, scan.stamp_ns):
        F, Q = smooth_motion(dt, noise.accel, noise.gyro_sigma, noise.bandwidth)
        turn = -float(gyro.turns(scan.stamp_ns, np.array([-dt]))[0])
        state, cov = state.copy(), cov.copy()
        state[2] += turn
        state[5], cov[5, :], cov[:, 5] = 0.0, 0.0, 0.0
        cov[5, 5] = noise.gyro_sigma**2
        beams = np.zeros((len(scan.times), 3))
        beams[:, 2] = gyro.turns(scan.stamp_ns, scan.times)
        twist = np.array([0.0, 0.0, gyro.rate()])
        return Expectation(
            transform_each(beams, scan.points),
            shares,
            cubic_between(shares, dt),
            state,
            cov,
            F,
            Q,
            twist,
            _sway(Q, dt),
            _BAR_MODES,
        )
    F, Q = smooth_motion(dt, noise.accel, noise.yaw_accel, noise.bandwidth)
    return Expectation(
        scan.points,
        shares,
        cubic_between(shares, dt),
        state,
        cov,
        F,
        Q,
        np.zeros(3),
        _sway(Q, dt),
        _BAR_MODES,
    )


def _sway(Q: FloatArray, dt: float) -> FloatArray:
    """Covariance (3, 3) that the modes of `clamped_bar` have under `smooth_motion`.

    Of the noise of a step's way a quarter comes from its final velocity; the rest is what the body sways.
    """
    sway: FloatArray = 12.0 * (Q[:3, :3] - 0.25 * dt * dt * Q[3:, 3:])
    return sway


def _along_odometry(
    scan: PreparedScan,
    shares: FloatArray,
    state: FloatArray,
    cov: FloatArray,
    dt: float,
    moved: tuple[FloatArray, FloatArray],
    odometry: OdometryTrack,
) -> Expectation:
    """Its drift is a random walk, which between two poses goes straight on average."""
    increment, increment_cov = moved
    turn, lever = np.eye(3), np.eye(3)
    turn[:2, :2] = rotation(state[2])
    c, s = np.cos(state[2]), np.sin(state[2])
    lever[0, 2] = -s * increment[0] - c * increment[1]
    lever[1, 2] = c * increment[0] - s * increment[1]
    drift = turn @ increment_cov @ turn.T + _LEAST_VARIANCE * np.eye(3)
    yaw = state[2] + increment[2]
    pose = compose(state[:3], increment)
    pose[2] = yaw
    moved_cov, Q = np.zeros((6, 6)), np.zeros((6, 6))
    moved_cov[:3, :3] = lever @ cov[:3, :3] @ lever.T
    moved_cov[3:, 3:] = Q[3:, 3:] = drift / dt**2
    Q[:3, :3] = drift
    F = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    basis = np.column_stack([1.0 - shares, np.zeros(len(shares)), shares, np.zeros(len(shares))])
    return Expectation(
        transform_each(odometry.beams(scan.stamp_ns, scan.times), scan.points),
        shares,
        basis,
        np.concatenate([pose, np.zeros(3)]),
        moved_cov,
        F,
        Q,
        odometry.twist(),
        drift,
        _BRIDGE_MODES,
    )
