"""Reads and writes the parameters of an autopilot, over any of its links."""

import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.errors import UserError
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.link import wire_opener
from companion.mavlink.parameter_names import aliases
from companion.mavlink.requests import command
from drivers.errors import PortError
from drivers.mavlink_frames import AutopilotIdentity, MavlinkMessage

PATIENCE = 10.0
"""How long an autopilot is waited for [s]."""
ANSWER_TIME = 0.7
"""How long answers are waited for before the question is asked again [s]."""
TRIES = 4
_BATCH = 10
"""Questions that may be open at once: an autopilot's buffers are small."""


@dataclass(frozen=True, slots=True)
class Value:
    """A parameter as the autopilot has it.

    Attributes:
        number: its value.
        kind: MAV_PARAM_TYPE.
    """

    number: float
    kind: int


class AutopilotClient:
    """A conversation with one autopilot.

    Args:
        url: device string of its link.
        baud: of a serial line.

    Raises:
        UserError: the link cannot be opened, or no autopilot speaks there.
    """

    def __init__(self, url: str, baud: int) -> None:
        try:
            self._wire = wire_opener(url, baud, "--mavlink")()
        except PortError as error:
            raise UserError(str(error)) from error
        self._end = Endpoint(mavlink2.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY, 0, None, None)
        self._identity = AutopilotIdentity()
        self._values: dict[str, Value] = {}
        self._newest: dict[str, MavlinkMessage] = {}
        self._greet_at = 0.0
        self._listen(lambda: self._identity.system is not None, PATIENCE)
        if self._identity.system is None:
            self.close()
            raise UserError(f"--mavlink {url}: no autopilot heard within {PATIENCE:.0f} s")

    @property
    def autopilot(self) -> str:
        """Name of the folder with its parameter files."""
        return "px4" if self._is_px4 else "ardupilot"

    def close(self) -> None:
        """Close the link."""
        self._wire.close()

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        """Values of those parameters that the autopilot has."""
        wanted = list(dict.fromkeys(names))
        self._values = {}
        for begin in range(0, len(wanted), _BATCH):
            batch = wanted[begin : begin + _BATCH]
            for _ in range(TRIES):
                missing = [name for name in batch if name not in self._values]
                if not missing:
                    break
                for name in missing:
                    self._send(
                        mavlink2.MAVLink_param_request_read_message(
                            self._system, mavlink2.MAV_COMP_ID_AUTOPILOT1, name.encode("ascii", "replace"), -1
                        )
                    )
                self._listen(lambda missing=missing: self._has(missing), ANSWER_TIME)  # type: ignore[misc]
        return dict(self._values)

    def write(self, name: str, number: float, kind: int) -> bool:
        """Write a parameter; whether the autopilot has taken it."""
        self._values.pop(name, None)
        for _ in range(TRIES):
            self._send(
                mavlink2.MAVLink_param_set_message(
                    self._system,
                    mavlink2.MAV_COMP_ID_AUTOPILOT1,
                    name.encode("ascii", "replace"),
                    self._packed(number, kind),
                    kind,
                )
            )
            self._listen(lambda: name in self._values, ANSWER_TIME)
            if name in self._values:
                return is_same(self._values[name].number, number)
        return False

    def message(self, kind: str, rate: float) -> MavlinkMessage | None:
        """The next message of a kind, asked for at a rate [Hz]; None when the autopilot does not send it."""
        number = getattr(mavlink2, f"MAVLINK_MSG_ID_{kind}")
        self._newest.pop(kind, None)
        for _ in range(TRIES):
            self._send(
                command(self._system, mavlink2.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / rate)
            )
            self._listen(lambda: kind in self._newest, ANSWER_TIME)
            if kind in self._newest:
                return self._newest[kind]
        return None

    @property
    def _is_px4(self) -> bool:
        return bool(self._identity.kind == mavlink2.MAV_AUTOPILOT_PX4)

    @property
    def _system(self) -> int:
        assert self._identity.system is not None
        return self._identity.system

    def _has(self, names: list[str]) -> bool:
        return all(name in self._values for name in names)

    def _send(self, message: MavlinkMessage) -> None:
        self._end.send(message, self._identity.system or 1)
        try:
            self._wire.write(self._end.take())
        except OSError as error:
            raise UserError(f"--mavlink: the link was lost: {error}") from error

    def _listen(self, done: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not done():
            if time.monotonic() >= self._greet_at:
                # Without a word from us an autopilot behind UDP does not know where we are.
                self._greet_at = time.monotonic() + 1.0
                beat = mavlink2.MAVLink_heartbeat_message(
                    mavlink2.MAV_TYPE_ONBOARD_CONTROLLER,
                    mavlink2.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    mavlink2.MAV_STATE_ACTIVE,
                    3,
                )
                self._end.send(beat, self._identity.system or 1)
                self._try_write(self._end.take())
            try:
                data = self._wire.read()
            except OSError as error:
                raise UserError(f"--mavlink: the link was lost: {error}") from error
            for message in self._end.parser.feed(data):
                self._hear(message)

    def _try_write(self, data: bytes) -> None:
        try:
            self._wire.write(data)
        except OSError:
            # Nobody there yet; the greeting is repeated.
            return

    def _hear(self, message: MavlinkMessage) -> None:
        self._identity.hear(message, time.monotonic_ns())
        is_autopilots = (
            message.get_srcSystem() == self._identity.system
            and message.get_srcComponent() == mavlink2.MAV_COMP_ID_AUTOPILOT1
        )
        if is_autopilots:
            self._newest[message.get_type()] = message
        if is_autopilots and message.get_type() == "PARAM_VALUE":
            kind = message.param_type
            self._values[message.param_id] = Value(self._unpacked(message.param_value, kind), kind)

    def _packed(self, number: float, kind: int) -> float:
        """PX4 puts the bytes of an integer where the float stands; ArduPilot turns it into one."""
        if self._is_px4 and kind == mavlink2.MAV_PARAM_TYPE_INT32:
            return float(struct.unpack("<f", struct.pack("<i", int(number)))[0])
        return number

    def _unpacked(self, number: float, kind: int) -> float:
        if self._is_px4 and kind == mavlink2.MAV_PARAM_TYPE_INT32:
            return float(struct.unpack("<i", struct.pack("<f", number))[0])
        return number


def is_same(a: float, b: float) -> bool:
    """Whether two values are one after a trip through float32."""
    return bool(np.float32(a) == np.float32(b)) or bool(abs(a - b) <= 1e-6 * max(abs(a), abs(b)))


@dataclass(frozen=True, slots=True)
class Comparison:
    """What an autopilot has where a file wants something.

    Attributes:
        asked: name in the file.
        name: name on the autopilot; empty when it has none of the parameter's names.
        has: value there, NaN without a name.
        wanted: value that the file means, under the autopilot's name.
        kind: MAV_PARAM_TYPE.
        why: the file's explanation.
    """

    asked: str
    name: str
    has: float
    wanted: float
    kind: int
    why: str

    @property
    def agrees(self) -> bool:
        """Whether nothing is to be done."""
        return bool(self.name) and is_same(self.has, self.wanted)


def compare_parameters(
    client: AutopilotClient, settings: Iterable[tuple[str, float, str]]
) -> list[Comparison]:
    """Read what a file wants, under whichever name the autopilot knows it.

    Args:
        client: to read with.
        settings: name, value and explanation of each line.
    """
    rows = list(settings)
    names = [name for name, _, _ in rows]
    found = client.read(names)
    others = {name: list(aliases(name)) for name in names if name not in found}
    found |= client.read(alias.name for list_ in others.values() for alias in list_)
    comparisons: list[Comparison] = []
    for name, wanted, why in rows:
        here, value = name, wanted
        for alias in others.get(name, []):
            if alias.name in found:
                here, value = alias.name, alias.convert(wanted)
        known = found.get(here)
        if known is None:
            comparisons.append(Comparison(name, "", float("nan"), wanted, 0, why))
        else:
            comparisons.append(Comparison(name, here, known.number, value, known.kind, why))
    return comparisons
