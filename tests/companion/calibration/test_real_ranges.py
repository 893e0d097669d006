"""A calibration on half a minute of a real drive, and what the filter makes of the next."""

import csv
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.calibration.ranges import fit_biases, ranges_by_anchor
from companion.config import load_config
from estimators import estimator_config_class, make_estimator
from estimators.geometry import transform
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range_bias import without_bias
from tests.strategies import range_frame

DATA = Path(__file__).parents[2] / "data" / "lias_planar"
TAG_0_IN_TROLLEY = np.array([[-0.0689, -0.1423]])
YAW_OFFSET, CLOCK_OFFSET = np.deg2rad(7.0), 0.005
"""Heading of the tracked body [rad]; UWB clock ahead of the motion capture's [s]."""
CALIBRATED, END = 30.0, 59.0


def seconds(text: str) -> float:
    since = datetime.strptime(text, "%Y-%m-%d %H:%M:%S.%f") - datetime(2022, 8, 15, 9, 42, 24)
    return since.total_seconds()


def rows(name: str) -> list[list[str]]:
    with (DATA / name).open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))[1:]


def tag_positions(times: FloatArray) -> FloatArray:
    """True tag 0, (N, 3) [m], by the motion capture."""
    captured = rows("motion_capture.csv")
    values = np.array([[float(cell) for cell in row[1:]] for row in captured])
    yaw = Rotation.from_quat(values[:, [4, 5, 6, 3]]).as_euler("ZYX")[:, 0] + YAW_OFFSET
    tags = [
        transform(np.array([x, y, psi]), TAG_0_IN_TROLLEY)[0]
        for x, y, psi in zip(values[:, 0], values[:, 1], yaw, strict=True)
    ]
    known = [seconds(row[0]) + CLOCK_OFFSET for row in captured]
    columns = [np.interp(times, known, column) for column in np.transpose(tags)]
    return np.column_stack([*columns, np.full(len(times), 0.965)])


@pytest.mark.parametrize("name", ["ekf", "graph"])
def test_calibrated_ranges_more_than_halve_the_error_of_a_filter_on_a_real_drive(name: str) -> None:
    config = load_config(DATA / "site.toml")
    setup = config.setup()
    frames: list[RangeFrame] = []
    for row in rows("uwb_three_tags.csv"):
        slants = np.array([float(cell) if cell else np.nan for cell in row[1:]]).reshape(8, 3)[:, 0]
        frames.append(range_frame(round(seconds(row[0]) * 1e9), list(range(8)), slants.tolist()))
    times = np.array([frame.stamp_ns for frame in frames]) * 1e-9
    tags = tag_positions(times)
    first = times < times[0] + CALIBRATED
    early = [frame for frame, is_early in zip(frames, first, strict=True) if is_early]
    found = fit_biases(ranges_by_anchor(early, tags[first], setup.anchors, frames[0].stamp_ns))
    biases = {anchor_id: fit.bias for anchor_id, fit in found.anchors.items()}

    rmse, most = {}, {}
    for known in ((), biases):
        estimator = make_estimator(name, estimator_config_class(name).model_validate({"nlos": []}), setup)
        errors = []
        for frame, tag, time in zip(frames, tags, times, strict=True):
            estimator.update(without_bias(frame, dict(known)))
            pose = estimator.pose_at(frame.stamp_ns)
            if times[0] + CALIBRATED <= time < times[0] + END:
                assert pose is not None
                errors.append(float(np.hypot(*(pose.xy - tag[:2]))))
        rmse[bool(known)], most[bool(known)] = float(np.sqrt(np.mean(np.square(errors)))), max(errors)
    assert rmse[True] < 0.5 * rmse[False]
    assert most[True] < 0.25
