"""Commands that walk a simulated robot: in memory, into a log, or on pseudo-terminals."""

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.padding import Padding

from companion.errors import UserError
from companion.interrupt import set_by_signals
from companion.run_folder import RAW_LOG
from companion.shipped_files import named_file
from companion.terminal import (
    INDENT,
    Seed,
    Sets,
    View,
    message_console,
    progress,
    result_console,
    shown_where,
)

if TYPE_CHECKING:
    from companion.sim.scenario import Scenario

out, err = result_console(), message_console()

Scenario_ = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Scenario file, or the name of one in params/scenarios.")
]


def demo(
    scenario: Annotated[str, typer.Argument(metavar="[SCENARIO]", help="Another scenario.")] = "square_room",
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Run folder to write.")] = Path(
        "out/demo"
    ),
    seed: Seed = None,
    view: View = "off",
    sets: Sets = None,
) -> None:
    """Run the whole chain without hardware and compare it with the truth.

    A simulated robot walks through a room. Its emulated LinkTrack tag and RPLIDAR speak their real serial
    protocols; drivers, estimator and MAVLink output are those of a live run. Everything is logged, then the
    log is replayed with three estimators side by side.
    """
    from companion.demo import run_demo
    from companion.tables import accuracy_table, anchor_table, sensor_lines

    where = shown_where(view)
    loaded = _load_scenario(scenario, seed, sets)
    with progress(err) as shown:
        bars = {name: shown.add_task(name, total=1.0) for name in ("walk", "replay", "pictures")}
        result, received = run_demo(
            loaded, folder, lambda stage, share: shown.update(bars[stage], completed=share)
        )
    out.print(f"[bold]{loaded.file.description}[/]" if loaded.file.description else loaded.name)
    out.print(accuracy_table(result, f"{result.duration:.0f} s against truth, seed {loaded.seed}"))
    out.print(anchor_table(result))
    for line in sensor_lines(result):
        out.print(Padding(line, INDENT, expand=False))
    definite = "all" if received.all_positive_definite else "NOT ALL"
    out.print(
        f"  autopilot: {received.poses} poses at {received.rate:.1f} Hz, {received.heartbeats} heartbeats, "
        f"covariance {definite} positive definite",
        soft_wrap=True,
    )
    out.print(f"  replay: repeats the poses sent to {received.replay_difference * 1000:.3f} mm")
    out.print()
    out.print(f"  picture  {folder / 'demo.png'}")
    out.print(f"  log      {folder / RAW_LOG}")
    out.print(f"  review   companion review {folder}")
    if where != "off":
        from companion.view.viewer import Viewer

        viewer = Viewer(where, loaded.config.view, folder / "replay.rrd")
        if viewer.is_page:
            err.print(f"open {viewer.page}; served until Ctrl-C")
            viewer.serve_until_interrupted()


def simulate(
    scenario: Scenario_,
    log: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log (MCAP) to write.")],
    seed: Seed = None,
    sets: Sets = None,
) -> None:
    """Write the raw log of a scenario, as fast as possible: real wire bytes plus the truth.

    The same scenario and seed give the same log.
    """
    from companion.sim.simulate import simulate as write_log

    loaded = _load_scenario(scenario, seed, sets)
    with progress(err) as shown:
        bar = shown.add_task(loaded.name, total=1.0)
        for share in write_log(loaded, log):
            shown.update(bar, completed=share)
        shown.update(bar, completed=1.0)
    out.print(f"{log}  {loaded.trajectory.duration:.0f} s, seed {loaded.seed}")


def emulate(scenario: Scenario_, seed: Seed = None, view: View = "off", sets: Sets = None) -> None:
    """Put a scenario's sensors on pseudo-terminals, in real time. Ctrl-C ends it.

    Prints the ports and the command that uses them. The robot begins to walk when the host asks for scans.
    --view shows where it truly is, and which anchors it sees.
    """
    from companion.sim.emulate import Emulator

    where = shown_where(view)
    loaded = _load_scenario(scenario, seed, sets)
    with ExitStack() as closing:
        stop = closing.enter_context(set_by_signals())
        emulator = Emulator(loaded)
        closing.callback(emulator.close)
        if where != "off":
            # Rerun would tell of every viewer that was closed.
            os.environ.setdefault("RUST_LOG", "off")
            from companion.view.walk_view import WalkView

            shown = WalkView(emulator.robot, where, lambda line: err.print(line, soft_wrap=True))
            closing.callback(shown.close)
        for name, port in emulator.ports.items():
            out.print(f"{name}  {port.path}")
        out.file.flush()
        options = " ".join(f"--set sensor.{name}.port={port.path}" for name, port in emulator.ports.items())
        site = named_file(Path(scenario), "scenarios").parent / loaded.file.site
        err.print("In another terminal:")
        err.print(f"  companion run --site {site.resolve()} {options}")
        emulator.run(stop, lambda line: err.print(line))


def _load_scenario(name: str, seed: int | None, sets: list[str] | None) -> "Scenario":
    from companion.sim.scenario import load_scenario

    scenario = load_scenario(named_file(Path(name), "scenarios"), seed, sets or [])
    if scenario.file.increments is not None:
        raise UserError(
            f"{name}: a scenario with [increments] has no bytes, only `companion evaluate` runs it"
        )
    return scenario
