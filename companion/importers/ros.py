"""ROS bags: LaserScan, Imu, Range, and as reference Odometry or PoseStamped; extra `ros`."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import UserError
from companion.importers.recording import Recording
from companion.importers.tables import single_range, yaw_of
from companion.log import Truth
from estimators.messages import ImuSample, Scan

_LEAST_STEP = 1e-6
"""Beams of a scan without times of its own follow each other by this [s]."""


def read_bag(path: Path, truth_topic: str | None) -> Recording:
    """Measurements of a ROS 1 bag, a ROS 2 bag (folder) or an MCAP file of ROS 2.

    The anchor of a sensor_msgs/Range is the number at the end of its frame_id, else of its topic.

    Args:
        path: the bag.
        truth_topic: of Odometry or PoseStamped messages to compare with; None for none.

    Raises:
        UserError: it cannot be read, has no such topic, or a range has no anchor.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise UserError(f"{path}: reading ROS bags needs rosbags: pip install companion[ros]") from error
    recording = Recording()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            if truth_topic is not None and truth_topic not in reader.topics:
                raise UserError(
                    f"--truth {truth_topic}: no such topic, there are: {', '.join(reader.topics)}"
                )
            for connection, _, data in reader.messages():
                kind = connection.msgtype.rpartition("/")[2]
                if kind in _READERS or connection.topic == truth_topic:
                    message = reader.deserialize(data, connection.msgtype)
                    _take(recording, kind, connection.topic, truth_topic, message)
    except AnyReaderError as error:
        raise UserError(f"cannot read the bag {path}: {error}") from error
    return recording


def _take(recording: Recording, kind: str, topic: str, truth_topic: str | None, message: Any) -> None:
    if topic == truth_topic:
        if kind not in ("Odometry", "PoseStamped"):
            raise UserError(f"--truth {topic}: holds {kind}, must be Odometry or PoseStamped")
        pose = message.pose.pose if kind == "Odometry" else message.pose
        q = pose.orientation
        yaw = yaw_of([q.x, q.y, q.z, q.w])
        recording.truths.append(Truth(_stamp_ns(message), np.array([pose.position.x, pose.position.y, yaw])))
    elif kind == "LaserScan":
        recording.scans.append(_scan(message))
    elif kind == "Imu":
        rate, force = message.angular_velocity, message.linear_acceleration
        gyro, accel = np.array([rate.x, rate.y, rate.z]), np.array([force.x, force.y, force.z])
        recording.inertial.append(ImuSample(_stamp_ns(message), gyro, accel))
    else:
        distance = float(message.range)
        if message.min_range <= distance <= message.max_range:
            recording.ranges.append(single_range(_stamp_ns(message), _anchor(message, topic), distance))


_READERS = ("LaserScan", "Imu", "Range")


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def _scan(message: Any) -> Scan:
    ranges = np.asarray(message.ranges, dtype=np.float64)
    number = np.arange(len(ranges), dtype=np.float64)
    seen = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
    return Scan(
        stamp_ns=_stamp_ns(message),
        angles=message.angle_min + message.angle_increment * number,
        ranges=np.where(seen, ranges, 0.0),
        beam_times=max(float(message.time_increment), _LEAST_STEP) * number,
        quality=np.zeros(len(ranges)),
    )


def _anchor(message: Any, topic: str) -> int:
    for name in (message.header.frame_id, topic):
        if found := re.search(r"(\d+)\D*$", name):
            return int(found[1])
    raise UserError(
        f"{topic}: neither frame_id {message.header.frame_id!r} nor topic ends in an anchor's number"
    )
