"""UWB positions and inertial accelerations in a Kalman filter that doubts positions which cannot be.

Its state has two more unknowns than `UwbImuEkf`'s: what positions of ranges that disagree have in common,
along the map's x and y, as a share of its standard deviation.
"""

from math import exp, sqrt

import numpy as np
from pydantic import Field

from estimators.base import Setup
from estimators.messages import FloatArray
from estimators.uwb.frame_solver import TagFix
from estimators.uwb.gd_pf import BLOCKED_TIME
from estimators.uwb.uwb_imu_ekf import UwbImuEkf

COMMON = slice(9, 11)


class UwbImuAdaptiveEkf(UwbImuEkf):
    """The same filter, which takes less of positions that cannot be.

    The covariance of an observed position grows with the square of what exceeds either limit, so its gain,
    and even its pull, fades: where it is further from the predicted position than states and observations may
    be apart, or three standard deviations where these are more; where it is further from the position
    observed before than the robot can have come, three standard deviations of both allowed for.

    What blocks a range stays for a while, and the positions of that while err alike, by more the more the
    ranges disagree. This common error is a Gauss-Markov process in the state: it takes more of the gain off
    the place than off the way from one position to the next, and its direction is learnt.

    Source: li2022, adaptive function on the gain, from state-observation distance and from the top speed; its
    formulas are lost, the factors are ours, and so is the common error (coloured noise in the state).
    """

    STATES = 11

    class Config(UwbImuEkf.Config):
        """Settings of `uwb_imu_adaptive_ekf`."""

        max_distance: float = Field(
            0.25, gt=0, le=100, description="state and observed position are at most so far apart [m]"
        )
        top_speed: float = Field(1.0, gt=0, le=50, description="of the robot [m/s]")
        blocked_time: float = Field(
            BLOCKED_TIME,
            gt=0,
            le=60,
            description="positions of ranges that disagree err alike for so long [s]",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._limits = config
        super().__init__(config, setup)

    def reset(self) -> None:
        """Wait for the first position again."""
        super().reset()
        self._observed: TagFix | None = None
        self._filter.P[COMMON, COMMON] = np.eye(2)

    def _place(self, fix: TagFix) -> None:
        super()._place(fix)
        self._observed = None

    def _motion(self, dt: float) -> tuple[FloatArray, FloatArray]:
        F, Q = super()._motion(dt)
        kept = exp(-dt / self._limits.blocked_time)
        F[COMMON, COMMON], Q[COMMON, COMMON] = kept * np.eye(2), (1.0 - kept**2) * np.eye(2)
        return F, Q

    def _observation(self, fix: TagFix) -> tuple[FloatArray, FloatArray, FloatArray]:
        H, position, R = super()._observation(fix)
        H[:, COMMON] = fix.common_sigma * np.eye(2)
        predicted = position + fix.common_sigma * self._filter.x[COMMON]
        deviation = _deviation(H @ self._filter.P @ H.T + R)
        apart = float(np.linalg.norm(fix.position[:2] - predicted))
        too_far = max(1.0, apart / max(self._limits.max_distance, 3.0 * deviation))
        before, self._observed = self._observed, fix
        if before is not None:
            step = float(np.linalg.norm(fix.position[:2] - before.position[:2]))
            deviation = _deviation(fix.widened_cov + before.widened_cov)
            dt = (fix.stamp_ns - before.stamp_ns) * 1e-9
            too_far *= max(1.0, step / (self._limits.top_speed * dt + 3.0 * deviation))
        return H, predicted, R * too_far**2


def _deviation(cov: FloatArray) -> float:
    """Standard deviation along one axis [m], the mean of x and y."""
    return sqrt(float(np.trace(cov[:2, :2])) / 2.0)
