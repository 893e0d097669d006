"""Emulated devices: they answer in the real protocols, and their sensors look at the simulated world.

Like the drivers they are free of I/O and clocks: requests go in through `feed`, `poll` gives the bytes
that the device has sent by now. One object serves a pseudo-terminal in real time and a simulation in
memory.
"""

from typing import Any, Protocol

import numpy as np

from companion.sim.scenario import ImuTable, LidarTable, Scenario, UwbTable
from companion.sim.trajectory import Motion
from drivers.linktrack_frames import Frame, NodeFrame2, NodeFrame3, NodeRange, TagFrame0, encode
from drivers.rplidar_protocol import (
    PACKET_SAMPLES,
    AccBoardFlag,
    Answer,
    AnswerType,
    Command,
    DeviceInfo,
    Health,
    HealthStatus,
    RequestDecoder,
    SampleRate,
    encode_answer,
    encode_descriptor,
    encode_express_capsule,
    encode_standard_node,
)
from estimators.geometry import transform, transform_each, wrap_angle
from estimators.messages import FloatArray

GRAVITY = 9.81
TAG_ID = 1
ROLE_ANCHOR, ROLE_TAG = 1, 2
LIDAR_MODELS = {"A1": 0x18, "A2": 0x28, "S1": 0x61}
SAMPLE_RATE = SampleRate(standard_us=500, express_us=250)
EXPRESS_OFFSET_Q3 = 60
"""Offset of every express sample, 7.5 deg: about what the optics of an A2 give beyond a metre or two."""
RESET_BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: emulated\r\n"


class Robot:
    """Where the simulated robot is; it stands still until it is told to begin.

    Args:
        scenario: walk and world.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._begin_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        """Start the walk, once."""
        if self._begin_ns is None:
            self._begin_ns = now_ns

    def arrived(self, now_ns: int) -> bool:
        """Whether the walk is over."""
        return self.seconds(now_ns) >= self.scenario.trajectory.duration

    def seconds(self, now_ns: int) -> float:
        """Time since the walk began [s]; 0 before."""
        return 0.0 if self._begin_ns is None else (now_ns - self._begin_ns) * 1e-9

    def motion(self, now_ns: int) -> Motion:
        """True motion at one instant (N = 1)."""
        return self.scenario.trajectory.at(np.array([self.seconds(now_ns)]))


class Device(Protocol):
    """What speaks on the far side of a port."""

    def feed(self, data: bytes, now_ns: int) -> None:
        """Bytes from the host."""
        ...

    def poll(self, now_ns: int) -> bytes:
        """Bytes sent since the last call."""
        ...


class LinkTrackDevice:
    """A LinkTrack tag on the robot: streams by itself from the moment it is built.

    Args:
        robot: that carries it.
        rng: noise of its ranges and inertial sensor.
        power_on_ns: time of its first frame.
    """

    def __init__(self, robot: Robot, rng: np.random.Generator, power_on_ns: int) -> None:
        self._robot = robot
        self._rng = rng
        self._uwb: UwbTable = robot.scenario.file.uwb
        self._imu: ImuTable = robot.scenario.file.imu
        self._power_on_ns = power_on_ns
        self._frames = 0
        config = robot.scenario.config
        self._anchor_ids = list(config.anchors)
        self._anchors = np.array(list(config.anchors.values()))
        self._tag = np.array(config.body.tag)
        self._height = config.body.height
        self._gyro_bias = rng.standard_normal(3) * self._imu.gyro_bias
        self._start_yaw = robot.motion(power_on_ns).pose[0, 2]
        self._stale = [0.0] * 8

    def feed(self, data: bytes, now_ns: int) -> None:
        """A tag needs nothing from the host."""

    def poll(self, now_ns: int) -> bytes:
        """Frames that were due by now."""
        out = b""
        while (due_ns := self._power_on_ns + round(self._frames * 1e9 / self._uwb.rate)) <= now_ns:
            out += encode(self._frame(due_ns))
            self._frames += 1
        return out

    def _frame(self, stamp_ns: int) -> Frame:
        motion = self._robot.motion(stamp_ns)
        pose = motion.pose[0]
        nodes = self._ranges(pose)
        clock_ms = (stamp_ns - self._power_on_ns) // 1_000_000
        sender: dict[str, Any] = {
            "id": TAG_ID,
            "role": ROLE_TAG,
            "local_time_ms": clock_ms,
            "system_time_ms": clock_ms,
            "voltage": 4.9,
        }
        if self._uwb.frame == "node_frame3":
            return NodeFrame3(**sender, nodes=nodes)
        turned = pose[2] - self._start_yaw
        sender |= {
            # The module's own position is never used: it shows what a tag without a fix sends.
            "pos": (1.0, 1.0, 1.0),
            "vel": (0.0, 0.0, 0.0),
            "eop": (2.55, 2.55, 2.55),
            "gyro": tuple(self._gyro(motion.yaw_rate[0])),
            "acc": tuple(self._accel(motion.accel[0])),
            "angle_deg": (0.0, 0.0, float(np.rad2deg(wrap_angle(turned)))),
            "quat_wxyz": (float(np.cos(turned / 2.0)), 0.0, 0.0, float(np.sin(turned / 2.0))),
        }
        if self._uwb.frame == "node_frame2":
            return NodeFrame2(**sender, nodes=nodes)
        for node in nodes:
            if node.id < len(self._stale):
                self._stale[node.id] = node.dis
        return TagFrame0(**sender | {"dis": tuple(self._stale)})

    def _ranges(self, pose: FloatArray) -> tuple[NodeRange, ...]:
        tag = np.array([*transform(pose, self._tag[None, :2])[0], self._height + self._tag[2]])
        clear = self._robot.scenario.world.line_of_sight(tag, self._anchors)
        distances = np.linalg.norm(self._anchors - tag, axis=1)
        noise = self._rng.standard_normal(len(distances)) * self._uwb.sigma
        excess = self._uwb.nlos_least + self._rng.exponential(self._uwb.nlos_mean, len(distances))
        failed = self._rng.random(len(distances)) < self._uwb.dropout
        ranges = distances + noise + np.where(clear, 0.0, excess)
        # Free-space loss; what is blocked loses more, most of all on its first path.
        received = -72.0 - 20.0 * np.log10(np.maximum(distances, 0.1)) - np.where(clear, 0.0, 6.0)
        first_path = received - np.where(clear, 2.0, 11.0)
        return tuple(
            NodeRange(
                ROLE_ANCHOR, anchor_id, max(float(ranges[i]), 0.001), float(first_path[i]), float(received[i])
            )
            for i, anchor_id in enumerate(self._anchor_ids)
            if not failed[i]
        )

    def _gyro(self, yaw_rate: float) -> list[float]:
        noise = self._rng.standard_normal(3) * self._imu.gyro_sigma
        gyro: list[float] = (np.array([0.0, 0.0, yaw_rate]) + self._gyro_bias + noise).tolist()
        return gyro

    def _accel(self, forward: float) -> list[float]:
        noise = self._rng.standard_normal(3) * self._imu.accel_sigma
        accel: list[float] = (np.array([forward, 0.0, GRAVITY]) + noise).tolist()
        return accel


class RplidarDevice:
    """An RPLIDAR on the robot: answers requests, and scans while asked to.

    Args:
        robot: that carries it; the walk begins with the first scan.
        rng: noise of its distances.
    """

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot
        self._rng = rng
        self._lidar: LidarTable = robot.scenario.file.lidar
        self._mounting = robot.scenario.config.lidar_mounting()
        self._height = robot.scenario.config.body.height + self._lidar.height
        self._requests = RequestDecoder()
        self._answers = b""
        self._stop()

    def feed(self, data: bytes, now_ns: int) -> None:
        """Obey requests; any request ends a running scan, as on the real device."""
        for command, _payload in self._requests.feed(data):
            self._stop()
            match command:
                case Command.GET_INFO:
                    serial = f"{self._robot.scenario.seed:032X}"[-32:]
                    self._answer(DeviceInfo(LIDAR_MODELS[self._lidar.model], (1, 29), 7, serial))
                case Command.GET_HEALTH:
                    self._answer(Health(HealthStatus.GOOD, 0))
                case Command.GET_SAMPLERATE:
                    self._answer(SAMPLE_RATE)
                case Command.GET_ACC_BOARD_FLAG:
                    self._answer(AccBoardFlag(has_motor_pwm=self._lidar.model == "A2"))
                case Command.SCAN:
                    self._scan(AnswerType.STANDARD_SCAN, SAMPLE_RATE.standard_us, now_ns)
                case Command.EXPRESS_SCAN:
                    self._scan(AnswerType.EXPRESS_SCAN, SAMPLE_RATE.express_us, now_ns)
                case Command.RESET:
                    self._answers += RESET_BANNER

    def poll(self, now_ns: int) -> bytes:
        """Answers, and the packets whose last sample was taken by now."""
        out, self._answers = self._answers, b""
        if self._scan_type is None:
            return out
        group = PACKET_SAMPLES[self._scan_type]
        taken = (now_ns - self._scan_begin_ns) // self._sample_ns
        packets = (taken - self._samples_sent) // group
        if packets > 0:
            first, count = self._samples_sent, packets * group
            self._samples_sent += count
            directions, distances = self._measure(first, count)
            if self._scan_type is AnswerType.STANDARD_SCAN:
                out += self._standard_nodes(first, directions, distances)
            else:
                out += self._express_capsules(directions, distances, is_first=first == 0)
        return out

    def _answer(self, answer: Answer) -> None:
        self._answers += encode_answer(answer)

    def _stop(self) -> None:
        self._scan_type: AnswerType | None = None

    def _scan(self, scan_type: AnswerType, sample_us: int, now_ns: int) -> None:
        self._robot.begin(now_ns)
        self._answers += encode_descriptor(scan_type)
        self._scan_type = scan_type
        self._scan_begin_ns = now_ns
        self._sample_ns = sample_us * 1000
        self._samples_sent = 0

    def _turns(self, first: int, count: int) -> FloatArray:
        """Revolutions since the scan began, when each of the samples was taken."""
        taken = np.arange(first + 1, first + count + 1, dtype=np.float64)
        return taken * (self._sample_ns * 1e-9 * self._lidar.rotation_hz)

    def _measure(self, first: int, count: int) -> tuple[FloatArray, FloatArray]:
        """Directions [deg], clockwise from forward, and distances [m] of consecutive samples."""
        turns = self._turns(first, count)
        directions = 360.0 * (turns % 1.0)
        since_scan = turns / self._lidar.rotation_hz
        times = np.asarray(since_scan + self._robot.seconds(self._scan_begin_ns), dtype=np.float64)
        pose = self._robot.scenario.trajectory.at(times).pose
        origins = transform_each(pose, self._mounting[None, :2])
        beams = pose[:, 2] + self._mounting[2] - np.deg2rad(directions)
        distances = self._robot.scenario.world.ray_cast(origins, beams, self._height)
        distances = distances + self._rng.standard_normal(count) * self._lidar.sigma
        missing = self._rng.random(count) < self._lidar.dropout
        seen = (distances >= self._lidar.min_range) & (distances <= self._lidar.max_range) & ~missing
        return directions, np.where(seen, distances, 0.0)

    def _standard_nodes(self, first: int, directions: FloatArray, distances: FloatArray) -> bytes:
        starts = np.diff(np.floor(self._turns(first - 1, len(directions) + 1))) > 0.0
        return b"".join(
            encode_standard_node(
                int(direction * 64) % (360 * 64),
                round(distance * 4000),
                15 if distance else 0,
                start,
            )
            for direction, distance, start in zip(
                directions.tolist(), distances.tolist(), starts.tolist(), strict=True
            )
        )

    def _express_capsules(self, directions: FloatArray, distances: FloatArray, is_first: bool) -> bytes:
        group = PACKET_SAMPLES[AnswerType.EXPRESS_SCAN]
        out = b""
        for i in range(0, len(directions), group):
            start_q6 = round(directions[i] * 64 + EXPRESS_OFFSET_Q3 * 8) % (360 * 64)
            millimetres = np.round(distances[i : i + group] * 1000).astype(int).tolist()
            out += encode_express_capsule(
                start_q6, is_first and i == 0, millimetres, [EXPRESS_OFFSET_Q3] * group
            )
        return out


def make_devices(robot: Robot, power_on_ns: int) -> dict[str, Device]:
    """An emulated device for every sensor of the site.

    Args:
        robot: that carries them.
        power_on_ns: when they are switched on.
    """
    devices: dict[str, Device] = {}
    sensors = robot.scenario.config.sensor
    for (name, table), rng in zip(sensors.items(), robot.scenario.rng.spawn(len(sensors)), strict=True):
        if table.driver == "linktrack":
            devices[name] = LinkTrackDevice(robot, rng, power_on_ns)
        else:
            devices[name] = RplidarDevice(robot, rng)
    return devices
