"""The commands. Data goes to files or stdout, progress and messages to stderr."""

import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from typer.core import TyperGroup

from companion import __version__
from companion.config import default_toml, load_config, params_dir
from companion.doctor import app as doctor
from companion.errors import UserError
from companion.evaluate_cli import app as evaluate_app
from companion.review_cli import review
from companion.smooth_cli import smooth

if TYPE_CHECKING:
    from companion.live import LiveRun, LiveStatus
    from companion.sim.scenario import Scenario
    from companion.view.viewer import Shown

EXIT_BAD_INPUT = 2


class _ScenarioUnlessNamed(TyperGroup):
    """Commands of `evaluate`; whatever is none of them is meant for `evaluate scenario`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in {*self.commands, *ctx.help_option_names}:
            args = ["scenario", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    help="Indoor pose for a robot from LinkTrack UWB and RPLIDAR, sent to ArduPilot or PX4 as MAVLink.\n\n"
    "Start with [bold]companion demo[/]: it runs the whole chain without hardware. Then "
    "[bold]companion run --site FILE[/] beside the autopilot, and [bold]companion replay LOG[/] to look "
    "at what happened.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(doctor, name="doctor")
app.add_typer(evaluate_app, name="evaluate", cls=_ScenarioUnlessNamed)
app.command()(smooth)
app.command()(review)
out = Console(emoji=False)
err = Console(stderr=True, highlight=False, emoji=False)

Scenario_ = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Scenario file, or the name of one in params/scenarios.")
]
Seed = Annotated[
    int | None, typer.Option("--seed", min=0, metavar="N", help="Instead of the scenario's own seed.")
]
View = Annotated[
    str,
    typer.Option(
        "--view",
        metavar="WHERE",
        help="Show it in Rerun while it runs: web (a page for a browser, see the table view), native (a "
        "window on this computer) or off.",
    ),
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change one setting of the site, e.g. --set pipeline.rate=20. Repeatable.",
    ),
]


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        out.print(__version__)
        raise typer.Exit


@app.command()
def demo(
    scenario: Annotated[str, typer.Argument(metavar="[SCENARIO]", help="Another scenario.")] = "square_room",
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Run folder to write.")] = Path(
        "out/demo"
    ),
    seed: Seed = None,
    sets: Sets = None,
) -> None:
    """Run the whole chain without hardware and compare it with the truth.

    A simulated robot walks through a room. Its emulated LinkTrack tag and RPLIDAR speak their real serial
    protocols; drivers, estimator and MAVLink output are those of a live run. Everything is logged, then the
    log is replayed with three estimators side by side.
    """
    from companion.demo import run_demo
    from companion.tables import accuracy_table, anchor_table, sensor_lines

    loaded = _load_scenario(scenario, seed, sets)
    with _progress() as progress:
        bars = {name: progress.add_task(name, total=1.0) for name in ("walk", "replay", "pictures")}
        result, received = run_demo(
            loaded, folder, lambda stage, share: progress.update(bars[stage], completed=share)
        )
    out.print(f"[bold]{loaded.file.description}[/]" if loaded.file.description else loaded.name)
    out.print(accuracy_table(result, f"{result.duration:.0f} s against truth, seed {loaded.seed}"))
    out.print(anchor_table(result))
    for line in sensor_lines(result):
        out.print(f"  {line}", highlight=False)
    definite = "all" if received.all_positive_definite else "NOT ALL"
    out.print(
        f"  autopilot: {received.poses} poses at {received.rate:.1f} Hz, {received.heartbeats} heartbeats, "
        f"covariance {definite} positive definite",
        highlight=False,
        soft_wrap=True,
    )
    out.print(
        f"  replay: repeats the poses sent to {received.replay_difference * 1000:.3f} mm", highlight=False
    )
    out.print()
    out.print(f"  picture  {folder / 'demo.png'}", highlight=False)
    out.print(f"  log      {folder / 'raw.mcap'}", highlight=False)
    out.print(f"  review   rerun {folder / 'replay.rrd'}", highlight=False)


@app.command()
def run(
    site: Annotated[Path, typer.Option("--site", metavar="FILE", help="Site file: anchors, sensors, start.")],
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default out/run-DATE-TIME.")
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option(
            "--mavlink",
            metavar="URL",
            help="pymavlink device string of the autopilot, e.g. /dev/ttyAMA0 or udpout:host:14550.",
        ),
    ] = None,
    view: View = "off",
    sets: Sets = None,
) -> None:
    """Estimate live: sensors in, poses to the autopilot, everything logged. Ctrl-C ends it.

    Missing ports and a missing autopilot are waited for, and taken up again after an unplug. A pose is only
    sent while its health is ok or degraded.
    """
    from companion.live import LiveRun

    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    config = load_config(_named(site, "sites"), assignments)
    folder = folder or Path("out") / datetime.now().astimezone().strftime("run-%Y%m%d-%H%M%S")
    begin = time.monotonic()

    def say(line: str) -> None:
        err.print(f"[dim]{time.monotonic() - begin:8.1f}[/]  {escape(line)}", soft_wrap=True)

    live = LiveRun(config, folder, say, _shown(view))
    say(f"{config.site.name}: estimator {config.pipeline.estimator}, log {folder / 'raw.mcap'}")
    stop = threading.Event()
    _stop_on_signal(stop)
    reporter = threading.Thread(target=_report, args=(live, stop), daemon=True)
    reporter.start()
    live.run(stop)
    reporter.join()
    say(f"ended: {live.status.poses_sent} poses sent; replay with: companion replay {folder / 'raw.mcap'}")


@app.command()
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
    with _progress() as progress:
        bar = progress.add_task(loaded.name, total=1.0)
        for share in write_log(loaded, log):
            progress.update(bar, completed=share)
        progress.update(bar, completed=1.0)
    out.print(f"{log}  {loaded.trajectory.duration:.0f} s, seed {loaded.seed}", highlight=False)


@app.command()
def emulate(scenario: Scenario_, seed: Seed = None, sets: Sets = None) -> None:
    """Put a scenario's sensors on pseudo-terminals, in real time. Ctrl-C ends it.

    Prints the ports and the command that uses them. The robot begins to walk when the host asks for scans.
    """
    from companion.sim.emulate import Emulator

    loaded = _load_scenario(scenario, seed, sets)
    emulator = Emulator(loaded)
    for name, port in emulator.ports.items():
        out.print(f"{name}  {port.path}", highlight=False)
    out.file.flush()
    options = " ".join(f"--set sensor.{name}.port={port.path}" for name, port in emulator.ports.items())
    site = _scenario_path(scenario).parent / loaded.file.site
    err.print("In another terminal:")
    err.print(f"  companion run --site {site.resolve()} {options}", soft_wrap=True)
    stop = threading.Event()
    _stop_on_signal(stop)
    try:
        emulator.run(stop, lambda line: err.print(line))
    finally:
        emulator.close()


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log (MCAP) of a run, demo or simulation.")],
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator", metavar="NAME", help="Estimator to run; repeat it to compare. Default: the log's."
        ),
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write; default out/LOGNAME.")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file instead of the log's own settings."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Run a log through the very same decoders and estimators as live, without sleeping.

    Writes poses.tum, ranges.csv (every range with its verdict), summary.json, config.toml and replay.rrd.
    The same log and settings give the same poses, byte for byte. The settings are those stored in the log;
    change them with --set, or give a corrected site file with --site.
    """
    from companion.log import Log
    from companion.replay import config_of, write_outputs
    from companion.replay import replay as run_log
    from companion.tables import accuracy_table, anchor_table, sensor_lines
    from companion.view.files import RerunFiles
    from estimators import ESTIMATORS

    opened = Log(log)
    config = load_config(_named(site, "sites"), sets or []) if site else config_of(opened, sets or [])
    names = list(dict.fromkeys(estimator or [config.pipeline.estimator]))
    for name in names:
        if name not in ESTIMATORS:
            raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    folder = folder or Path("out") / log.stem
    view = RerunFiles(config, names, folder / "replay.rrd", opened.start_ns)
    begin = time.perf_counter()
    with _progress() as progress:
        bar = progress.add_task(log.name, total=1.0)
        result = run_log(
            opened,
            config,
            names,
            view.tick,
            lambda share: progress.update(bar, completed=share),
            view.chunk,
        )
        view.close()
        progress.update(bar, completed=1.0)
    took = time.perf_counter() - begin
    write_outputs(result, folder)
    if not result.complete:
        err.print(f"[yellow]{log} ends abruptly (killed process or damaged file); replayed what is there[/]")
    title = f"{result.duration:.1f} s in {took:.1f} s ({result.duration / took:.0f} x real time)"
    out.print(accuracy_table(result, title + ("" if result.errors else ", no truth in the log")))
    out.print(anchor_table(result))
    for line in sensor_lines(result):
        out.print(f"  {line}", highlight=False)
    out.print(
        f"  written to {folder}: poses.tum, ranges.csv, summary.json, config.toml, replay.rrd",
        highlight=False,
    )


@evaluate_app.command("scenario")
def evaluate(
    scenario: Scenario_,
    trials: Annotated[int, typer.Option("--trials", min=1, metavar="N", help="Number of runs.")] = 30,
    seed: Seed = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            "--estimators",
            metavar="A,B",
            help="Estimators, NAME or NAME:PARAM; uwb_ls and lidar are the single sensors. "
            "Default: uwb_ls,lidar,ekf.",
        ),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the figures there, too.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Processes; default: one a core.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Measure estimators on many trials of a scenario: errors, consistency, time, distance from the bound.

    The word "scenario" may be left out: [bold]companion evaluate huang2024[/]. Trial k has the seed S + k
    for everything random: obstacles, start, gait and noise. The same seed gives the same figures, times
    excepted. Where the scenario holds figures of a paper, they stand below ours.
    """
    from companion.evaluation import DEFAULT_CHOICES, evaluate_scenario
    from companion.evaluation_table import evaluation_notes, evaluation_table

    choices = DEFAULT_CHOICES if estimators is None else estimators.split(",")
    if json_file is not None and not json_file.parent.is_dir():
        raise UserError(f"cannot write {json_file}: there is no folder {json_file.parent}")
    with _progress() as progress:
        bar = progress.add_task("trials", total=trials)
        result = evaluate_scenario(
            _scenario_path(scenario),
            trials,
            seed,
            choices,
            sets or [],
            workers or os.cpu_count() or 1,
            lambda: progress.advance(bar),
        )
    out.print(evaluation_table(result))
    for line in evaluation_notes(result):
        out.print(f"  {line}", highlight=False, soft_wrap=True)
    if json_file is not None:
        try:
            json_file.write_text(json.dumps(result.to_json(), indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise UserError(f"cannot write {json_file}: {error.strerror}") from error


@app.command("dump-config")
def dump_config(
    site: Annotated[
        Path | None, typer.Option("--site", metavar="FILE", help="Resolve this site file instead.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Print every setting with its default, or a site's whole configuration, as TOML."""
    if site is None:
        if sets:
            raise UserError("--set: give --site too; the defaults alone are no configuration to change")
        sys.stdout.write(default_toml())
    else:
        sys.stdout.write(load_config(_named(site, "sites"), sets or []).to_toml())


def main() -> NoReturn:
    """Entry point: user errors become one line and exit code 2."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=err, show_path=False)]
    )
    try:
        app()
    except UserError as error:
        err.print("[red]error:[/]", escape(str(error)), soft_wrap=True)
        sys.exit(EXIT_BAD_INPUT)
    sys.exit(0)


def _named(path: Path, kind: str) -> Path:
    """A file of the user's, or one of ours in `params/KIND` by its bare name."""
    if path.exists() or path.suffix or path.name != str(path):
        return path
    ours = params_dir() / kind / f"{path}.toml"
    if not ours.exists():
        names = ", ".join(sorted(p.stem for p in ours.parent.glob("*.toml")))
        raise UserError(f"no file {path} and none of that name in params/{kind}; there are: {names}")
    return ours


def _shown(view: str) -> "Shown":
    match view:
        case "web" | "native" | "off":
            return view
    raise UserError(f"--view: {view!r} is none of web, native, off")


def _scenario_path(name: str) -> Path:
    return _named(Path(name), "scenarios")


def _load_scenario(name: str, seed: int | None, sets: list[str] | None) -> "Scenario":
    from companion.sim.scenario import load_scenario

    scenario = load_scenario(_scenario_path(name), seed, sets or [])
    if scenario.file.increments is not None:
        raise UserError(
            f"{name}: a scenario with [increments] has no bytes, only `companion evaluate` runs it"
        )
    return scenario


@contextmanager
def _progress() -> Iterator[Progress]:
    with Progress(
        TextColumn("{task.description:>9}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,
    ) as progress:
        yield progress


def _stop_on_signal(stop: threading.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())


def _report(live: "LiveRun", stop: threading.Event) -> None:
    """Show the state of a run until it stops: a status line on a terminal, else a line every 5 s."""
    if err.is_terminal:
        with err.status("starting") as status:
            while not stop.wait(0.2):
                status.update(_status_line(live.status))
    else:
        while not stop.wait(5.0):
            err.print(_status_line(live.status), soft_wrap=True)


def _status_line(status: "LiveStatus") -> str:
    pose, health = status.pose, status.health
    if pose is None or health is None:
        return "starting: no pose yet"
    x, y = pose.xy
    sigma = float(max(pose.cov[0, 0], pose.cov[1, 1]) ** 0.5)
    parts = [
        f"[bold]{health.state}[/]",
        f"x {x:6.2f}  y {y:6.2f} m  yaw {degrees(pose.yaw):6.1f} deg",
        f"sigma {sigma:.2f} m",
        f"sent {status.poses_sent}",
        f"autopilot {status.autopilot}" if status.autopilot is not None else "no autopilot heard",
    ]
    parts += [f"{name} dropped {count}" for name, count in status.dropped.items() if count]
    if status.stale_ticks:
        parts.append(f"late {status.stale_ticks}")
    if health.reason:
        parts.append(health.reason)
    return "  ".join(parts)
