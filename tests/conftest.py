"""Fixtures shared by all tests."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pytest
from hypothesis import HealthCheck, settings

from companion.cli import main
from companion.config import Config, load_config
from companion.shipped_files import params_dir
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import simulate

# A busy machine is no failure: examples may take their time.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

SCENARIO = params_dir() / "scenarios" / "square_room.toml"
SITE = params_dir() / "sites" / "demo_room.toml"

SHORT_WALK = "[trajectory]\nwaypoints = [[1.5, 1.2], [3.5, 1.2], [3.5, 2.4]]\nlaps = 0\nrest = 1.0\n"
"""Some 11 s: two legs and one turn."""

COLUMN = "[[world.boxes]]\ncentre = [4.0, 3.6]\nsize = [0.6, 0.6]\nheight = 3.0\n"
"""It hides an anchor from some places."""


def write_scenario(folder: Path, trajectory: str = SHORT_WALK, more: str = "") -> Path:
    """A scenario in the demo's room with another walk and other sensors."""
    path = folder / "scenario.toml"
    path.write_text(f'site = "{SITE}"\n{trajectory}{more}{COLUMN}', encoding="utf-8")
    return path


def write_log(scenario: Scenario, path: Path) -> Path:
    """Log of a scenario."""
    for _ in simulate(scenario, path):
        pass
    return path


@dataclass(frozen=True, slots=True)
class Called:
    """What a command left, as `subprocess` tells it."""

    returncode: object
    stdout: str
    stderr: str


Command: TypeAlias = Callable[..., Called]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Command:
    """The program, called with arguments in this process: to start another one takes seconds."""

    def call(*arguments: str | Path) -> Called:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["companion", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return Called(ended.value.code, said.out, said.err)

    return call


@pytest.fixture
def config() -> Config:
    """Configuration of the demo room."""
    return load_config(SITE)


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a short walk in the demo's room."""
    folder = tmp_path_factory.mktemp("short")
    return write_log(load_scenario(write_scenario(folder), 3, []), folder / "short.mcap")
