"""Measurements of a walk without bytes: increments, ranges and landmarks straight from the truth.

For scenarios with a table `[increments]`. Devices and drivers are left out, so a trial takes a fraction of a
second; what a measurement claims of its noise is what was drawn.
"""

from dataclasses import replace

import numpy as np

from companion.sim.inertial import draw_inertial
from companion.sim.ranging import draw_delay_biases, draw_ranging
from companion.sim.scenario import Scenario
from companion.sim.scenario_tables import IncrementsTable, KidnapTable, LandmarksTable
from companion.sim.simulate import START_NS
from estimators.base import Setup
from estimators.geometry import between, rotation, transform_each, wrap_angle, wrap_angles
from estimators.immutable import immutable
from estimators.messages import (
    Attitude,
    FloatArray,
    ImuSample,
    IntArray,
    LandmarkFrame,
    Measurement,
    PoseIncrement,
    RangeFrame,
)

TAG_ID = 1


@immutable
class MeasuredWalk:
    """What the sensors of a scenario measured, and the truth.

    Attributes:
        stamps_ns: (K,) instants of the increments.
        poses: (K, 3) true x [m], y [m], yaw [rad] at these, map frame.
        increments: K, each from the instant before; the first only founds the reference.
        range_frames: in stamp order.
        unblocked: for every range frame the anchors whose range came straight.
        excess: for every range frame by how much what stands between makes the range of each anchor too long
            [m].
        landmark_frames: in stamp order.
        inertial: attitudes, each before the sample of its instant.
    """

    stamps_ns: IntArray
    poses: FloatArray
    increments: list[PoseIncrement]
    range_frames: list[RangeFrame]
    unblocked: list[list[int]]
    excess: list[dict[int, float]]
    landmark_frames: list[LandmarkFrame]
    inertial: list[ImuSample | Attitude]

    def in_order(self) -> list[Measurement]:
        """All measurements in stamp order; of one instant inertial first, then increment, landmarks last."""
        every: list[Measurement] = [*self.inertial, *self.increments]
        every += [*self.range_frames, *self.landmark_frames]
        return sorted(every, key=lambda measurement: measurement.stamp_ns)


def setup_of(scenario: Scenario) -> Setup:
    """Geometry of the site, with the scenario's landmarks numbered from 0."""
    landmarks = scenario.file.landmarks
    positions = landmarks.positions if landmarks is not None else []
    known = {i: np.array(position) for i, position in enumerate(positions)}
    return replace(scenario.config.setup(), landmarks=known)


def measure(scenario: Scenario) -> MeasuredWalk:
    """Draw everything that is measured on the walk.

    Args:
        scenario: with a table `[increments]`; its generator is used up, load it anew for a second walk.
    """
    odometry, landmarks = scenario.file.increments, scenario.file.landmarks
    assert odometry is not None
    inertial = scenario.file.inertial
    odometry_rng, uwb_rng, landmark_rng, inertial_rng = scenario.rng.spawn(4)
    stamps_ns, poses = _instants(scenario, odometry.rate)
    range_frames, unblocked, excess = _range_frames(scenario, uwb_rng)
    return MeasuredWalk(
        stamps_ns=stamps_ns,
        poses=poses,
        increments=_increments(odometry, odometry_rng, stamps_ns, poses, scenario.file.kidnap),
        range_frames=range_frames,
        unblocked=unblocked,
        excess=excess,
        landmark_frames=_landmark_frames(scenario, landmarks, landmark_rng) if landmarks else [],
        inertial=draw_inertial(scenario, inertial, inertial_rng) if inertial else [],
    )


def _instants(scenario: Scenario, rate: float) -> tuple[IntArray, FloatArray]:
    """Stamps (K,) of a sensor that measures regularly from the start, and true poses (K, 3)."""
    count = int(scenario.trajectory.duration * rate) + 1
    since_ns = np.array([round(k * 1e9 / rate) for k in range(count)], dtype=np.int64)
    times: FloatArray = since_ns.astype(np.float64) * 1e-9
    return START_NS + since_ns, scenario.trajectory.at(times).pose


def _increments(
    table: IncrementsTable,
    rng: np.random.Generator,
    stamps_ns: IntArray,
    poses: FloatArray,
    kidnaps: list[KidnapTable],
) -> list[PoseIncrement]:
    """Increments from each pose to the next.

    Noise of a step is white. A trial's scale error, drift and slip repeat in all of its steps; the covariance
    of a step has their variance too, but nothing says that they are the same as in the step before.
    """
    sigma_yaw, drift_sigma = np.deg2rad(table.sigma_yaw_deg), np.deg2rad(table.yaw_drift_deg)
    scale = table.scale_sigma * rng.standard_normal()
    drift = drift_sigma * rng.standard_normal()
    noise = rng.standard_normal((len(poses) - 1, 3)) * [table.sigma_x, table.sigma_y, sigma_yaw]
    map_cov = np.diag([table.sigma_x**2, table.sigma_y**2])
    slips = [(place, place.slip_sigma * rng.standard_normal(2)) for place in table.diverging]
    increments = [
        PoseIncrement(int(stamps_ns[0]), int(stamps_ns[0]), np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
    ]
    for k, step_noise in enumerate(noise):
        from_ns, to_ns = stamps_ns[k : k + 2].tolist()
        carried = [kidnap for kidnap in kidnaps if from_ns < START_NS + round(kidnap.at * 1e9) <= to_ns]
        if any(kidnap.noticed for kidnap in carried):
            increments.append(PoseIncrement(to_ns, to_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True))
            continue
        R_body_map = rotation(poses[k, 2]).T
        # A step lasts a tenth of a second: as if the robot had stood while it was carried unnoticed.
        step = np.zeros(3) if carried else between(poses[k], poses[k + 1])
        length = float(np.hypot(step[0], step[1]))
        value = step * [1.0 + scale, 1.0 + scale, 1.0]
        value[:2] += R_body_map @ step_noise[:2]
        slip_variance = 0.0
        for place, slip in slips:
            if place.holds(poses[k]):
                value[:2] += R_body_map @ slip * length
                slip_variance += (place.slip_sigma * length) ** 2
        value[2] = wrap_angle(value[2] + drift * length + step_noise[2])
        cov = np.zeros((3, 3))
        cov[:2, :2] = R_body_map @ map_cov @ R_body_map.T + table.scale_sigma**2 * np.outer(
            step[:2], step[:2]
        )
        cov[:2, :2] += slip_variance * np.eye(2)
        cov[2, 2] = sigma_yaw**2 + (drift_sigma * length) ** 2
        increments.append(PoseIncrement(from_ns, to_ns, value, cov, is_keyframe=True))
    return increments


def _range_frames(
    scenario: Scenario, rng: np.random.Generator
) -> tuple[list[RangeFrame], list[list[int]], list[dict[int, float]]]:
    """Ranges that err as those of the emulated tag do, the anchors that it saw, and what NLOS added."""
    uwb, config = scenario.file.uwb, scenario.config
    stamps_ns, poses = _instants(scenario, uwb.rate)
    ids = np.array(list(config.anchors), dtype=np.int64)
    anchors = np.array(list(config.anchors.values()))
    lever_arm = np.array(config.body.tag)
    tag_height = np.full(len(poses), config.body.height + lever_arm[2])
    tags = np.column_stack([transform_each(poses, lever_arm[None, :2]), tag_height])
    seconds = ((stamps_ns - START_NS) * 1e-9).tolist()
    clear = np.array([scenario.sees(tag, t) for tag, t in zip(tags, seconds, strict=True)])
    distances = np.linalg.norm(anchors - tags[:, None], axis=2)
    distances += draw_delay_biases(uwb, len(ids), rng)
    drawn = draw_ranging(uwb, distances, clear, rng, rng.spawn(1)[0])
    frames = [
        RangeFrame(
            stamp_ns,
            TAG_ID,
            ids[got],
            drawn.ranges[k, got],
            drawn.rx_power[k, got],
            drawn.fp_power[k, got],
        )
        for k, (stamp_ns, got) in enumerate(zip(stamps_ns.tolist(), drawn.received, strict=True))
    ]
    excess = [dict(zip(config.anchors, row, strict=True)) for row in drawn.excess.tolist()]
    return frames, [ids[row].tolist() for row in clear & drawn.received], excess


def _landmark_frames(
    scenario: Scenario, table: LandmarksTable, rng: np.random.Generator
) -> list[LandmarkFrame]:
    """Landmarks within range; nothing hides them."""
    stamps_ns, poses = _instants(scenario, table.rate)
    bearing_sigma = float(np.deg2rad(table.bearing_sigma_deg))
    offsets = np.array(table.positions) - poses[:, None, :2]
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    ranges = distances + table.range_sigma * rng.standard_normal(distances.shape)
    bearings = np.arctan2(offsets[..., 1], offsets[..., 0]) - poses[:, 2:]
    bearings = wrap_angles(bearings + bearing_sigma * rng.standard_normal(distances.shape))
    return [
        LandmarkFrame(
            stamp_ns,
            np.flatnonzero(seen),
            ranges[k, seen],
            bearings[k, seen],
            table.range_sigma,
            bearing_sigma,
        )
        for k, (stamp_ns, seen) in enumerate(
            zip(stamps_ns.tolist(), distances <= table.max_range, strict=True)
        )
    ]
