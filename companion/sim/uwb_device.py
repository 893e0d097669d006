"""An emulated Nooploop LinkTrack module on the robot."""

from dataclasses import replace
from typing import Any

import numpy as np

from companion.sim.ranging import draw_delay_biases, draw_ranging
from companion.sim.robot import Robot
from companion.sim.scenario import ImuTable, UwbTable
from companion.sim.trajectory import Motion
from drivers.linktrack import LinkTrack
from drivers.linktrack_frames import encode
from drivers.linktrack_types import (
    AnchorFrame0,
    AnchorRange,
    AoaNodeFrame0,
    AoaNodeRange,
    Coordinates,
    ErrorBits,
    ErrorFrame0,
    Frame,
    NodeData,
    NodeFrame0,
    NodeFrame2,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeRange,
    Role,
    SettingFrame0,
    SystemFrame0,
    TagBlock,
    TagFrame0,
    TagRanges,
)
from estimators.geometry import transform, wrap_angle
from estimators.messages import FloatArray

GRAVITY = 9.81
TAG_ID = 1
CONSOLE_ID = 0
_NO_FIX = (1.0, 1.0, 1.0)
_PROTOCOLS = {  # numbers in Setting_Frame0; AOA models have their own
    "anchor_frame0": 0,
    "tag_frame0": 1,
    "node_frame2": 4,
    "node_frame3": 5,
    "node_frame4": 6,
    "node_frame5": 7,
}
_TRAFFIC_EVERY = 10  # frames
_NMEA = b"$GNGGA,000000.00,0000.0000,N,00000.0000,E,0,00,9.9,0.0,M,0.0,M,,*5C\r\n"


class LinkTrackDevice:
    """A LinkTrack tag on the robot, or for the frames of consoles a console: streams by itself.

    Args:
        robot: that carries it.
        rng: noise of its ranges and inertial sensor.
    """

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot
        self._rng = rng
        self._power_rng = rng.spawn(1)[0]
        self._uwb: UwbTable = robot.scenario.file.uwb
        self._imu: ImuTable = robot.scenario.file.imu
        config = robot.scenario.config
        self._anchor_ids = list(config.anchors)
        self._anchors = np.array(list(config.anchors.values()))
        self._biases = draw_delay_biases(self._uwb, len(self._anchor_ids), rng)
        self._tag = np.array(config.body.tag)
        self._height = config.body.height
        self._gyro_bias = rng.standard_normal(3) * self._imu.gyro_bias
        self._start_yaw = float(robot.scenario.trajectory.start[2])
        self.power_on(0)

    def power_on(self, now_ns: int) -> None:
        """Boot: both clocks begin at 0, nothing was measured yet."""
        self._power_on_ns = now_ns
        self._frames = 0
        self._stale = [0.0] * 8
        self._host = LinkTrack(LinkTrack.Config())
        self._answers = b""

    def protect(self, active: bool) -> None:
        """A module has nothing that stops it."""

    def feed(self, data: bytes, now_ns: int) -> None:
        """Answer requests to read settings and versions; writes are not obeyed."""
        for request in self._host.frames(data):
            if isinstance(request, SettingFrame0) and request.mix & 1:
                self._answers += encode(self._settings(self._clock_ms(now_ns)))
            elif isinstance(request, SystemFrame0) and request.mix & 1:
                versions = replace(request, mix=0, product_version=(0, 2), hardware_version=(0, 2))
                self._answers += encode(
                    replace(
                        versions,
                        firmware_version=(0, 0, 3, 4),
                        baud_rate=921_600,
                        role=self._role,
                        id=self._id,
                    )
                )

    def poll(self, now_ns: int) -> bytes:
        """Answers, and the frames that were due by now."""
        out, self._answers = self._answers, b""
        while (due_ns := self._power_on_ns + round(self._frames * 1e9 / self._uwb.rate)) <= now_ns:
            out += encode(self._frame(due_ns))
            if self._uwb.other_traffic and self._frames % _TRAFFIC_EVERY == 0:
                out += self._traffic(self._clock_ms(due_ns))
            self._frames += 1
        return out

    @property
    def _role(self) -> Role:
        return Role.CONSOLE if self._uwb.frame in ("anchor_frame0", "node_frame4") else Role.TAG

    @property
    def _id(self) -> int:
        return CONSOLE_ID if self._role is Role.CONSOLE else TAG_ID

    def _clock_ms(self, now_ns: int) -> int:
        return (now_ns - self._power_on_ns) // 1_000_000

    def _frame(self, stamp_ns: int) -> Frame:
        motion = self._robot.motion(stamp_ns)
        nodes = self._ranges(motion.pose[0], stamp_ns)
        clock_ms = self._clock_ms(stamp_ns)
        sender: dict[str, Any] = {
            "id": self._id,
            "role": self._role,
            "local_time_ms": clock_ms,
            "system_time_ms": clock_ms,
            "voltage": 4.9,
        }
        match self._uwb.frame:
            case "node_frame3":
                return NodeFrame3(**sender, nodes=nodes)
            case "node_frame4":
                anchors = tuple(AnchorRange(node.id, node.dis) for node in nodes)
                return NodeFrame4(**sender, tags=(TagRanges(TAG_ID, 4.9, anchors),))
            case "node_frame5":
                return NodeFrame5(**sender, nodes=nodes)
            case "aoa_node_frame0":
                # Bearings are emulated as straight ahead: no estimator reads them.
                rows = [AoaNodeRange(n.role, n.id, n.dis, 0.0, n.fp_rssi, n.rx_rssi) for n in nodes]
                return AoaNodeFrame0(**sender, nodes=tuple(rows))
            case "anchor_frame0":
                block = TagBlock(Role.TAG, TAG_ID, _NO_FIX, self._distances(nodes))
                return AnchorFrame0(**sender, nodes=(block,))
            case "tag_frame0":
                return TagFrame0(**sender, **self._state(motion), dis=self._distances(nodes))
            case "node_frame2":
                return NodeFrame2(**sender, **self._state(motion), nodes=nodes)

    def _state(self, motion: Motion) -> dict[str, Any]:
        turned = motion.pose[0, 2] - self._start_yaw
        return {
            # The module's own position is never used: it shows what a tag without a fix sends.
            "pos": _NO_FIX,
            "vel": (0.0, 0.0, 0.0),
            "eop": (2.55, 2.55, 2.55),
            "gyro": tuple(self._gyro(motion.yaw_rate[0])),
            "acc": tuple(self._accel(motion.accel[0])),
            "angle_deg": (0.0, 0.0, float(np.rad2deg(wrap_angle(turned)))),
            "quat_wxyz": (float(np.cos(turned / 2.0)), 0.0, 0.0, float(np.sin(turned / 2.0))),
        }

    def _distances(self, nodes: tuple[NodeRange, ...]) -> Any:
        """Eight distances as the frames without blocks have them: a range that fails leaves the old one."""
        for node in nodes:
            if node.id < len(self._stale):
                self._stale[node.id] = node.dis
        return tuple(self._stale)

    def _traffic(self, clock_ms: int) -> bytes:
        """What else may be on the port: user data that looks like a frame, text, a complaint."""
        data = NodeData(Role.NODE, 9, b"\x55\x04\x78\x00 hello")
        complaint = ErrorFrame0(self._id, self._role, clock_ms, ErrorBits.POSITION, (0, 0, 0))
        return encode(NodeFrame0(self._id, self._role, (data,))) + _NMEA + encode(complaint)

    def _settings(self, clock_ms: int) -> SettingFrame0:
        positions: dict[int, Coordinates] = dict(
            zip(self._anchor_ids, map(tuple, self._anchors.tolist()), strict=True)
        )
        return SettingFrame0(
            mix=0,
            role=self._role,
            math_model=None,
            baud_rate=921_600,
            system_channel=9,
            id=self._id,
            update_rate_hz=round(self._uwb.rate),
            system_id=0,
            on_off=1,
            filter_factor=0,
            mode=0,
            protocol=_PROTOCOLS.get(self._uwb.frame, 0),
            tx_gain_db=33.5,
            node_capacity=0,
            local_time_ms=clock_ms,
            anchor_group=0,
            anchors=tuple(positions.get(i, (None, None, None)) for i in range(10)),
        )

    def _ranges(self, pose: FloatArray, stamp_ns: int) -> tuple[NodeRange, ...]:
        tag = np.array([*transform(pose, self._tag[None, :2])[0], self._height + self._tag[2]])
        clear = self._robot.scenario.sees(tag, self._robot.seconds(stamp_ns))
        distances = np.linalg.norm(self._anchors - tag, axis=1) + self._biases
        drawn = draw_ranging(self._uwb, distances, clear, self._rng, self._power_rng)
        self._robot.on_ranging(stamp_ns, dict(zip(self._anchor_ids, drawn.excess.tolist(), strict=True)))
        return tuple(
            NodeRange(
                Role.ANCHOR,
                anchor_id,
                max(float(drawn.ranges[i]), 0.001),
                float(drawn.fp_power[i]),
                float(drawn.rx_power[i]),
            )
            for i, anchor_id in enumerate(self._anchor_ids)
            if drawn.received[i]
        )

    def _gyro(self, yaw_rate: float) -> list[float]:
        noise = self._rng.standard_normal(3) * self._imu.gyro_sigma
        gyro: list[float] = (np.array([0.0, 0.0, yaw_rate]) + self._gyro_bias + noise).tolist()
        return gyro

    def _accel(self, forward: float) -> list[float]:
        noise = self._rng.standard_normal(3) * self._imu.accel_sigma
        accel: list[float] = (np.array([forward, 0.0, GRAVITY]) + noise).tolist()
        return accel
