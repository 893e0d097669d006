"""Faults on a line: each does what its name says, while it lasts, and nothing else."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from companion.errors import UserError
from companion.sim.line import Line
from companion.sim.robot import Robot
from companion.sim.scenario import FaultTable, load_scenario
from tests.conftest import write_scenario

SECOND = 1_000_000_000
STEP = SECOND // 100
PACKET = bytes(range(100))


class Counter:
    """A device that sends the same packet at every poll and notes what happens to it."""

    def __init__(self) -> None:
        self.powered: list[int] = []
        self.heard = b""
        self.protected: list[bool] = []

    def power_on(self, now_ns: int) -> None:
        self.powered.append(now_ns)

    def feed(self, data: bytes, now_ns: int) -> None:  # noqa: ARG002
        self.heard += data

    def poll(self, now_ns: int) -> bytes:  # noqa: ARG002
        return PACKET

    def protect(self, active: bool) -> None:
        self.protected.append(active)


Run = Callable[..., tuple[Counter, dict[int, bytes]]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Three seconds of a line whose fault lasts for the second one; poll number -> bytes at the host."""

    def run(kind: str, share: float = 0.5) -> tuple[Counter, dict[int, bytes]]:
        robot = Robot(load_scenario(write_scenario(tmp_path), 1, []))
        fault = FaultTable.model_validate(
            {"sensor": "uwb", "kind": kind, "at": 1.0, "duration": 1.0, "share": share}
        )
        device = Counter()
        line = Line(device, robot, [fault], np.random.default_rng(1), 0)
        robot.begin(0)
        return device, {k: line.poll(k * STEP) for k in range(300)}

    return run


def outside(arrived: dict[int, bytes]) -> set[bytes]:
    return {data for k, data in arrived.items() if not 100 <= k <= 200}


def during(arrived: dict[int, bytes]) -> list[bytes]:
    return [arrived[k] for k in range(100, 200)]


@pytest.mark.parametrize(
    "kind", ["garbage", "truncation", "bit_flips", "stall", "silence", "disconnect", "protection_stop"]
)
def test_a_fault_ends_with_its_time(run: Run, kind: str) -> None:
    _, arrived = run(kind)
    assert outside(arrived) == {PACKET}


def test_garbage_is_put_between_the_bytes(run: Run) -> None:
    _, arrived = run("garbage")
    hit = [data for data in during(arrived) if data != PACKET]
    assert 20 < len(hit) < 80
    for data in hit:
        extra = len(data) - len(PACKET)
        assert 1 <= extra <= 64
        assert any(data[:at] + data[at + extra :] == PACKET for at in range(len(PACKET) + 1))


def test_truncation_loses_the_rest(run: Run) -> None:
    _, arrived = run("truncation")
    assert all(PACKET.startswith(data) for data in during(arrived))
    assert 20 < sum(data != PACKET for data in during(arrived)) < 80


def test_bit_flips_change_one_bit_of_a_share_of_the_bytes(run: Run) -> None:
    _, arrived = run("bit_flips", share=0.1)
    changed = np.frombuffer(b"".join(during(arrived)), np.uint8) ^ np.frombuffer(PACKET * 100, np.uint8)
    assert set(np.bitwise_count(changed)) == {0, 1}
    assert np.count_nonzero(changed) / len(changed) == pytest.approx(0.1, abs=0.01)


def test_a_stall_holds_bytes_back_and_loses_none(run: Run) -> None:
    _, arrived = run("stall")
    assert set(during(arrived)) == {b""}
    assert arrived[200] == PACKET * 101


def test_silence_loses_what_is_sent(run: Run) -> None:
    _, arrived = run("silence")
    assert set(during(arrived)) == {b""}
    assert arrived[200] == PACKET


def test_a_disconnected_device_starts_anew_when_it_is_back(run: Run) -> None:
    device, arrived = run("disconnect")
    assert set(during(arrived)) == {b""}
    assert device.powered == [0, 2 * SECOND]


def test_a_protection_stop_is_told_to_the_device(run: Run) -> None:
    device, _ = run("protection_stop")
    assert device.protected == [False] * 100 + [True] * 100 + [False] * 100


def test_a_plug_pulled_by_hand_takes_both_directions(tmp_path: Path) -> None:
    robot = Robot(load_scenario(write_scenario(tmp_path), 1, []))
    device = Counter()
    line = Line(device, robot, [], np.random.default_rng(1), 0)
    line.plugged = False
    assert not line.attached(SECOND)
    line.feed(b"lost", SECOND)
    assert line.poll(SECOND) == b""
    line.plugged = True
    line.feed(b"heard", 2 * SECOND)
    assert line.poll(2 * SECOND) == PACKET
    assert device.heard == b"heard"
    assert device.powered == [0, 2 * SECOND]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            'sensor = "moon"\nkind = "stall"',
            r"faults\.0\.sensor: no sensor 'moon' in the site, there are: uwb, lidar",
        ),
        ('sensor = "uwb"\nkind = "protection_stop"', "only an rplidar has a protection_stop"),
        ('sensor = "uwb"\nkind = "rain"', r"faults\.0\.kind"),
    ],
)
def test_faults_that_cannot_be_are_refused(tmp_path: Path, fault: str, said: str) -> None:
    path = write_scenario(tmp_path, more=f"[[faults]]\n{fault}\nat = 1.0\nduration = 1.0\n")
    with pytest.raises(UserError, match=said):
        load_scenario(path, 1, [])
