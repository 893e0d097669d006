"""Inertial samples and attitudes of a walk without bytes, straight from the truth."""

import numpy as np
from scipy.spatial.transform import Rotation

from companion.sim.scenario import Scenario
from companion.sim.scenario_tables import InertialTable
from companion.sim.simulate import START_NS
from estimators.geometry import transform_each
from estimators.messages import Attitude, FloatArray, ImuSample
from estimators.models.inertial import GRAVITY

_STEP = 0.005
"""Half the base of the second difference that gives accelerations [s]."""


def draw_inertial(
    scenario: Scenario, table: InertialTable, rng: np.random.Generator
) -> list[ImuSample | Attitude]:
    """What a sensor at the tag, level but for its tilt error, measures on the walk.

    Args:
        scenario: the walk and the place of the tag.
        table: how the sensor errs.
        rng: source of its errors.

    Returns:
        In stamp order, of each instant the attitude first.
    """
    bias = table.accel_bias * rng.standard_normal(3)
    tilt = np.deg2rad(table.tilt_sigma_deg) * rng.standard_normal(2)
    count = int(scenario.trajectory.duration * table.rate) + 1
    times: FloatArray = np.arange(count) / table.rate
    motion = scenario.trajectory.at(times)
    yaw = np.unwrap(motion.pose[:, 2])
    walk = np.deg2rad(table.heading_walk_deg) / np.sqrt(table.rate) * np.cumsum(rng.standard_normal(count))
    accel_map = np.column_stack([_accelerations(scenario, times), np.full(count, GRAVITY)])
    R_map_body = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    accel = R_map_body.inv().apply(accel_map) + bias
    accel += table.accel_sigma * rng.standard_normal((count, 3))
    gyro = np.column_stack([np.zeros((count, 2)), motion.yaw_rate])
    gyro += table.gyro_sigma * rng.standard_normal((count, 3))
    believed = np.column_stack([yaw - yaw[0] + walk, np.full((count, 2), tilt)])
    quats = Rotation.from_euler("ZYX", believed).as_quat(scalar_first=True)
    found: list[ImuSample | Attitude] = []
    for k in range(count):
        stamp_ns = START_NS + round(k * 1e9 / table.rate)
        found += [Attitude(stamp_ns, quats[k]), ImuSample(stamp_ns, gyro[k], accel[k])]
    return found


def _accelerations(scenario: Scenario, times: FloatArray) -> FloatArray:
    """Horizontal acceleration of the tag, (N, 2) [m/s^2], map frame."""
    lever_arm = np.array(scenario.config.body.tag)[None, :2]
    before, now, after = (
        transform_each(scenario.trajectory.at(times + shift).pose, lever_arm)
        for shift in (-_STEP, 0.0, _STEP)
    )
    accelerations: FloatArray = (after - 2.0 * now + before) / _STEP**2
    return accelerations
