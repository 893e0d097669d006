"""A world that moves and measures exactly as the EKF's models say, so that its covariance can be judged."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from estimators.base import Report, Setup, Start
from estimators.ekf import Ekf
from estimators.lidar.keyframes import START_SPEED_SIGMA
from estimators.messages import FloatArray, PoseIncrement, RangeFrame
from tests.strategies import range_frame

STEP = 0.02
"""Ranges every second step (25 Hz), increments every fifth (10 Hz), keyframes every 20th."""
STEP_NS = round(STEP * 1e9)
RANGE_SIGMA = 0.1
INCREMENT_SIGMA = np.array([0.01, 0.01, 0.005])
ACCEL_NOISE, YAW_ACCEL_NOISE = 0.3, 0.3

HALL = Setup(
    anchors={
        10: np.array([-9.0, -8.0, 2.5]),
        11: np.array([9.0, -7.5, 3.0]),
        12: np.array([8.5, 8.0, 2.8]),
        13: np.array([-8.0, 7.0, 2.6]),
    },
    tag_in_body=np.array([0.15, -0.1, 0.35]),
    start=Start(np.array([0.5, -0.5, 2.8]), np.array([0.15, 0.15, 0.08])),
    height=0.3,
    height_sigma=0.02,
    level_sigma=0.02,
)
"""Anchors far enough out that no walk of a few seconds passes under one; a heading next to half a turn."""


def matched_config(range_gate: float = 1 - 1e-9) -> Ekf.Config:
    """The world's own noise, nothing blocked; the gates let everything pass unless told otherwise."""
    return Ekf.Config(
        range_sigma=RANGE_SIGMA,
        range_gate=range_gate,
        nlos=(),
        increment_gate=1 - 1e-9,
        accel_noise=ACCEL_NOISE,
        yaw_accel_noise=YAW_ACCEL_NOISE,
    )


def tag_of(pose: FloatArray, setup: Setup) -> FloatArray:
    """Tag antenna (3,) in the map."""
    arm = complex(*setup.tag_in_body[:2]) * np.exp(1j * pose[2])
    return np.array([pose[0] + arm.real, pose[1] + arm.imag, setup.height + setup.tag_in_body[2]])


def true_ranges(stamp_ns: int, pose: FloatArray, setup: Setup) -> RangeFrame:
    """Noiseless slant ranges to all anchors."""
    tag = tag_of(pose, setup)
    slants = [float(np.linalg.norm(anchor - tag)) for anchor in setup.anchors.values()]
    return range_frame(stamp_ns, list(setup.anchors), slants)


def true_increment(reference: FloatArray, pose: FloatArray) -> FloatArray:
    """Motion (3,) from one pose to another, in complex numbers."""
    step = complex(*(pose - reference)[:2]) * np.exp(-1j * reference[2])
    return np.array([step.real, step.imag, np.angle(np.exp(1j * (pose[2] - reference[2])))])


def pose_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Difference of two poses (3,), yaw as an angle."""
    error = estimate[:3] - truth[:3]
    error[2] = np.angle(np.exp(1j * error[2]))
    return error


@dataclass(frozen=True, slots=True)
class Walk:
    """What one run leaves: error and covariance of the pose at every second, and the range reports."""

    errors: tuple[FloatArray, ...]
    covs: tuple[FloatArray, ...]
    reports: tuple[Report, ...]


def measured_walk(
    truth: FloatArray, rng: np.random.Generator, noise: float = 1.0
) -> list[tuple[int, list[RangeFrame | PoseIncrement]]]:
    """Measurements of a true path, step by step.

    Args:
        truth: (N, 6) pose and velocity every `STEP`.
        rng: source of noise.
        noise: factor on all standard deviations.
    """
    cov = np.diag(INCREMENT_SIGMA**2)
    steps: list[tuple[int, list[RangeFrame | PoseIncrement]]] = []
    keyframe = 0
    for k, state in enumerate(truth):
        stamp_ns, taken = k * STEP_NS, list[RangeFrame | PoseIncrement]()
        if k % 2 == 0:
            frame = true_ranges(stamp_ns, state[:3], HALL)
            slants = frame.ranges + noise * rng.normal(0.0, RANGE_SIGMA, len(frame.ranges))
            taken.append(range_frame(stamp_ns, frame.anchor_ids.tolist(), slants.tolist()))
        if k % 5 == 0:
            value = true_increment(truth[keyframe, :3], state[:3])
            value += noise * rng.normal(0.0, INCREMENT_SIGMA)
            taken.append(PoseIncrement(keyframe * STEP_NS, stamp_ns, value, cov, k % 20 == 0))
            keyframe = k if k % 20 == 0 else keyframe
        steps.append((stamp_ns, taken))
    return steps


def random_truth(rng: np.random.Generator, seconds: float) -> FloatArray:
    """States (N, 6) drawn from the filter's prior and moved by white acceleration of its densities."""
    start = HALL.start
    state = np.concatenate([start.pose + rng.normal(0.0, start.sigma), rng.normal(0.0, START_SPEED_SIGMA, 3)])
    # Position and velocity that white acceleration of density 1 adds in a step.
    factor = np.linalg.cholesky(np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]]))
    density = np.array([ACCEL_NOISE, ACCEL_NOISE, YAW_ACCEL_NOISE])
    states = [state]
    for _ in range(round(seconds / STEP)):
        kick = factor @ rng.normal(size=(2, 3)) * density
        state = np.concatenate([state[:3] + STEP * state[3:] + kick[0], state[3:] + kick[1]])
        states.append(state)
    return np.array(states)


@cache
def walk(seed: int, seconds: int, range_gate: float = 1 - 1e-9) -> Walk:
    """One Monte Carlo run; the trial's number is its seed."""
    rng = np.random.default_rng(seed)
    truth = random_truth(rng, seconds)
    ekf = Ekf(matched_config(range_gate), HALL)
    errors, covs, reports = [], [], []
    for k, (_, taken) in enumerate(measured_walk(truth, rng)):
        for measurement in taken:
            report = ekf.update(measurement)
            if isinstance(measurement, RangeFrame):
                reports.append(report)
        if k and k % round(1 / STEP) == 0:
            mean, cov = ekf.state
            errors.append(pose_error(mean, truth[k]))
            covs.append(cov[:3, :3])
    return Walk(tuple(errors), tuple(covs), tuple(reports))


def constant_velocity_truth(velocity: FloatArray, seconds: float) -> FloatArray:
    """States (N, 6) from the start pose with a constant velocity in the map [m/s, rad/s]."""
    times = STEP * np.arange(round(seconds / STEP) + 1)
    poses = HALL.start.pose + times[:, None] * velocity
    return np.column_stack([poses, np.broadcast_to(velocity, poses.shape)])
