"""The cable between an emulated device and the host, and the faults that a scenario puts on it."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from companion.sim.robot import Robot
from companion.sim.scenario import FaultTable


class Device(Protocol):
    """What speaks on the far side of a line; free of I/O and of clocks, like the drivers."""

    def power_on(self, now_ns: int) -> None:
        """Begin anew, as after a pulled plug."""
        ...

    def feed(self, data: bytes, now_ns: int) -> None:
        """Bytes from the host."""
        ...

    def poll(self, now_ns: int) -> bytes:
        """Bytes sent since the last call."""
        ...

    def protect(self, active: bool) -> None:
        """Enter or leave the condition in which the device stops itself."""
        ...


class Line:
    """A device as the host meets it.

    Args:
        device: on the far side; powered through the line.
        robot: whose walk tells when faults happen.
        faults: of this line.
        rng: what the faults draw from.
        now_ns: when everything is switched on.
    """

    def __init__(
        self,
        device: Device,
        robot: Robot,
        faults: Sequence[FaultTable],
        rng: np.random.Generator,
        now_ns: int,
    ) -> None:
        self._device = device
        self._robot = robot
        self._faults = list(faults)
        self._rng = rng
        self.plugged = True
        """False pulls the plug by hand, whatever the faults say."""
        self._held = b""
        self._attached = True
        device.power_on(now_ns)

    def attached(self, now_ns: int) -> bool:
        """Whether the plug is in; the device starts anew when it is put back."""
        attached = self.plugged and not any(fault.kind == "disconnect" for fault in self._active(now_ns))
        if attached and not self._attached:
            self._held = b""
            self._device.power_on(now_ns)
        self._attached = attached
        return attached

    def feed(self, data: bytes, now_ns: int) -> None:
        """Bytes from the host."""
        if self.attached(now_ns):
            self._device.feed(data, now_ns)

    def poll(self, now_ns: int) -> bytes:
        """Bytes that reach the host now."""
        if not self.attached(now_ns):
            return b""
        active = self._active(now_ns)
        self._device.protect(any(fault.kind == "protection_stop" for fault in active))
        data = self._device.poll(now_ns)
        for fault in active:
            data = self._damage(fault, data)
        if any(fault.kind == "stall" for fault in active):
            self._held += data
            return b""
        data, self._held = self._held + data, b""
        return data

    def _active(self, now_ns: int) -> list[FaultTable]:
        seconds = self._robot.seconds(now_ns)
        return [fault for fault in self._faults if fault.at <= seconds < fault.at + fault.duration]

    def _damage(self, fault: FaultTable, data: bytes) -> bytes:
        """The bytes of one poll with what a bad line does to them."""
        if fault.kind == "silence":
            return b""
        if not data:
            return data
        if fault.kind == "bit_flips":
            raw = np.frombuffer(data, np.uint8)
            bits = (1 << self._rng.integers(0, 8, len(raw))).astype(np.uint8)
            return np.where(self._rng.random(len(raw)) < fault.share, raw ^ bits, raw).tobytes()
        if self._rng.random() >= fault.share:
            return data
        at = int(self._rng.integers(0, len(data) + 1))
        if fault.kind == "garbage":
            return data[:at] + self._rng.bytes(int(self._rng.integers(1, 65))) + data[at:]
        if fault.kind == "truncation":
            return data[:at]
        return data
