"""`companion params`: files and names of versions, and an autopilot on a real socket."""

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import pytest
from pymavlink import mavparm
from pymavlink.dialects.v20 import all as mavlink2
from rich.console import Console
from typer.testing import CliRunner

from companion import params_cli
from companion.cli import app
from companion.errors import UserError
from companion.mavlink.parameter_files import FOLDERS, read_settings, settings_file
from companion.mavlink.parameter_names import aliases
from companion.shipped_files import params_dir
from tests.companion.mavlink.scripted_autopilot import ScriptedAutopilot

FLOAT, INTEGER = mavlink2.MAV_PARAM_TYPE_REAL32, mavlink2.MAV_PARAM_TYPE_INT32
USES = ("uwb_lidar", "uwb_position", "rover", "gps_and_uwb")


@pytest.fixture(autouse=True)
def soon_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """An autopilot on this machine answers sooner than one behind a radio."""
    monkeypatch.setattr("companion.autopilot_client.ANSWER_TIME", 0.2)


def as_float(number: int) -> float:
    """How PX4 sends an integer."""
    return float(struct.unpack("<f", struct.pack("<i", number))[0])


@contextmanager
def served(autopilot: ScriptedAutopilot) -> Iterator[str]:
    """The autopilot behind UDP; gives the device string."""
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        wire.settimeout(0.005)

        def serve() -> None:
            peer = None
            while not stop.is_set():
                try:
                    data, peer = wire.recvfrom(4096)
                    autopilot.feed(data, time.monotonic_ns())
                except TimeoutError:
                    pass
                if peer and (data := autopilot.poll(time.monotonic_ns())):
                    wire.sendto(data, peer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"udpout:127.0.0.1:{wire.getsockname()[1]}"
        finally:
            stop.set()
            thread.join()


def ardupilot(name: str = "uwb_lidar", **other: float) -> ScriptedAutopilot:
    """One that has all that a file wants, but for some."""
    autopilot = ScriptedAutopilot(time.monotonic_ns())
    wanted = {s.name: s.value for s in read_settings(params_dir() / "ardupilot" / f"{name}.parm")}
    autopilot.parameters = {key: (value, FLOAT) for key, value in (wanted | other).items()}
    return autopilot


def run(*arguments: str, text: str = "") -> tuple[int, str]:
    # Wide enough for a table whose texts are not folded.
    with patch.object(params_cli, "out", Console(highlight=False, width=160)):
        result = CliRunner().invoke(app, ["params", *arguments], input=text)
    if isinstance(result.exception, UserError):
        raise result.exception
    return result.exit_code, result.output


@pytest.mark.parametrize("use", USES)
def test_the_files_of_both_versions_mean_the_same(use: str) -> None:
    new = {s.name: s.value for s in read_settings(params_dir() / "ardupilot" / f"{use}.parm")}
    old = {s.name: s.value for s in read_settings(params_dir() / "ardupilot" / f"{use}-4.6.parm")}
    renamed = {}
    for name, value in old.items():
        (known, number) = next(
            ((a.name, a.convert(value)) for a in aliases(name) if a.name in new), (name, value)
        )
        renamed[known] = number
    assert renamed == new


@pytest.mark.parametrize(("autopilot", "ending"), FOLDERS.items())
def test_every_line_of_our_files_has_a_name_that_fits_and_an_explanation(autopilot: str, ending: str) -> None:
    paths = sorted((params_dir() / autopilot).glob(f"*{ending}"))
    assert {path.stem.removesuffix("-4.6") for path in paths} == set(USES)
    for path in paths:
        settings = read_settings(path)
        assert len(settings) > 8
        assert len({s.name for s in settings}) == len(settings)
        assert all(s.why and len(s.name) <= 16 for s in settings)


@pytest.mark.parametrize("use", USES)
def test_mavproxys_loader_reads_our_files(use: str, capfd: pytest.CaptureFixture[str]) -> None:
    for path in (params_dir() / "ardupilot").glob(f"{use}*.parm"):
        loaded = mavparm.MAVParmDict()
        assert loaded.load(str(path))
        assert dict(loaded) == {s.name: s.value for s in read_settings(path)}
    assert "Invalid" not in capfd.readouterr().out


def test_an_autopilot_that_agrees() -> None:
    with served(ardupilot()) as url:
        code, said = run("check", "uwb_lidar", "--mavlink", url)
    assert code == 0
    assert "16 of 16 parameters agree" in said


def test_every_mismatch_is_explained_and_lost_answers_are_asked_for_again() -> None:
    autopilot = ardupilot(EK3_SRC1_YAW=2.0)
    del autopilot.parameters["VISO_TYPE"]
    autopilot.deaf_to = 3
    with served(autopilot) as url:
        code, said = run("check", "uwb_lidar", "--mavlink", url)
    assert code == 1
    assert "EK3_SRC1_YAW" in said
    assert "external navigation (6); 2 would be GPS" in said
    assert "not on this autopilot" in said
    assert "14 of 16 parameters agree" in said


def test_old_names_are_found_and_inverted_meanings_turned(tmp_path: Path) -> None:
    path = tmp_path / "mine.parm"
    path.write_text("ARMING_SKIPCHK 0\nGPS1_TYPE 0\nRNGFND1_MAX 7.0\nMAV2_EXTRA1 10\nMAV_SYSID 7\n")
    autopilot = ScriptedAutopilot(time.monotonic_ns())
    old = {
        "ARMING_CHECK": 1.0,
        "GPS_TYPE": 1.0,
        "RNGFND1_MAX_CM": 700.0,
        "SR1_EXTRA1": 4.0,
        "SYSID_THISMAV": 7.0,
    }
    autopilot.parameters = {name: (value, FLOAT) for name, value in old.items()}
    with served(autopilot) as url:
        code, said = run("check", str(path), "--mavlink", url)
    assert code == 1
    assert "GPS_TYPE (GPS1_TYPE)" in said
    assert "SR1_EXTRA1 (MAV2_EXTRA1)" in said
    assert "3 of 5 parameters agree" in said


@pytest.mark.parametrize("checks", [0, 1, 2, 6, 0x7FFFFE])
def test_arming_checks_survive_the_way_to_the_new_name_and_back(checks: int) -> None:
    (there,) = aliases("ARMING_CHECK")
    (back,) = aliases("ARMING_SKIPCHK")
    again = back.convert(there.convert(float(checks)))
    # All bits one by one are all of them.
    assert again == (1.0 if checks in (1, 0x7FFFFE) else float(checks))
    assert (there.name, back.name) == ("ARMING_SKIPCHK", "ARMING_CHECK")


def test_apply_asks_writes_and_can_be_undone(tmp_path: Path) -> None:
    autopilot = ardupilot(EK3_SRC1_YAW=1.0, EK3_SRC1_POSXY=3.0)
    undo = tmp_path / "undo.parm"
    with served(autopilot) as url:
        arguments = ("--mavlink", url, "--undo", str(undo))
        code, _ = run("apply", "uwb_lidar", *arguments, text="n\n")
        assert (code, undo.exists()) == (1, False)
        assert autopilot.parameters["EK3_SRC1_YAW"][0] == 1.0
        code, said = run("apply", "uwb_lidar", *arguments, text="y\n")
        assert code == 0
        assert f"companion params apply {undo}" in said.replace("\n", "")
        assert autopilot.parameters["EK3_SRC1_YAW"][0] == 6.0
        assert autopilot.parameters["EK3_SRC1_POSXY"][0] == 6.0
        code, _ = run("apply", str(undo), "--mavlink", url, "--undo", str(tmp_path / "redo.parm"), "--yes")
        assert code == 0
    assert autopilot.parameters["EK3_SRC1_YAW"][0] == 1.0
    assert autopilot.parameters["EK3_SRC1_POSXY"][0] == 3.0


def test_a_refused_write_is_told(tmp_path: Path) -> None:
    autopilot = ardupilot(EK3_SRC1_YAW=1.0)
    autopilot.read_only = {"EK3_SRC1_YAW"}
    with served(autopilot) as url:
        arguments = ("apply", "uwb_lidar", "--mavlink", url, "--yes", "--undo", str(tmp_path / "u.parm"))
        code, said = run(*arguments)
    assert code == 1
    assert "refused by the autopilot: EK3_SRC1_YAW" in said


def test_integers_of_px4_go_both_ways(tmp_path: Path) -> None:
    autopilot = ScriptedAutopilot(time.monotonic_ns(), kind=mavlink2.MAV_AUTOPILOT_PX4)
    for setting in read_settings(params_dir() / "px4" / "uwb_lidar.params"):
        is_float = setting.name in ("EKF2_EVP_NOISE", "EKF2_EV_DELAY") or "_POS_" in setting.name
        packed = setting.value if is_float else as_float(int(setting.value))
        autopilot.parameters[setting.name] = (packed, FLOAT if is_float else INTEGER)
    autopilot.parameters["EKF2_EV_CTRL"] = (as_float(0), INTEGER)
    with served(autopilot) as url:
        code, said = run("check", "uwb_lidar", "--mavlink", url)
        assert code == 1
        assert "9 of 10 parameters agree" in said
        run("apply", "uwb_lidar", "--mavlink", url, "--yes", "--undo", str(tmp_path / "u.parm"))
    packed, _ = autopilot.parameters["EKF2_EV_CTRL"]
    assert struct.unpack("<i", struct.pack("<f", packed))[0] == 9


def test_a_file_that_is_none_is_told_before_anyone_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "broken.parm"
    path.write_text("EK3_ENABLE 1\nEK3_SRC1_YAW\n")
    with pytest.raises(UserError, match="line 2 is no parameter"):
        run("check", str(path), "--mavlink", "udpout:127.0.0.1:9")
    with pytest.raises(UserError, match="there are: gps_and_uwb, rover, uwb_lidar, uwb_position"):
        settings_file("nothing", "ardupilot")


def test_no_autopilot_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.autopilot_client.PATIENCE", 0.3)
    with pytest.raises(UserError, match="no autopilot heard"):
        run("check", "uwb_lidar", "--mavlink", "udpout:127.0.0.1:9")
