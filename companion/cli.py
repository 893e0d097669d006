"""The commands. Data goes to files or stdout, progress and messages to stderr."""

import logging
import os
import sys
import threading
import time
from contextlib import ExitStack
from datetime import datetime
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.logging import RichHandler
from rich.markup import escape
from typer.core import TyperGroup

from companion import __version__
from companion.calibrate_cli import app as calibrate_app
from companion.doctor import app as doctor
from companion.errors import UserError
from companion.evaluate_cli import app as evaluate_app
from companion.interrupt import set_by_signals
from companion.log_cli import edit, export, import_recording, make_map
from companion.params_cli import app as params_app
from companion.review_cli import review
from companion.sitl_cli import sitl
from companion.smooth_cli import smooth
from companion.terminal import Seed, Sets, message_console, progress, result_console

if TYPE_CHECKING:
    from companion.config import Config
    from companion.live import LiveRun, LiveStatus
    from companion.log import Log
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
out, err = result_console(), message_console()

Scenario_ = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Scenario file, or the name of one in params/scenarios.")
]
View = Annotated[
    str,
    typer.Option(
        "--view",
        metavar="WHERE",
        help="Show it in Rerun: web (a page for a browser, see the table view), native (a window on this "
        "computer) or off. `run` and `emulate` show it while it runs.",
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
        out.print(f"  {line}")
    definite = "all" if received.all_positive_definite else "NOT ALL"
    out.print(
        f"  autopilot: {received.poses} poses at {received.rate:.1f} Hz, {received.heartbeats} heartbeats, "
        f"covariance {definite} positive definite",
        soft_wrap=True,
    )
    out.print(f"  replay: repeats the poses sent to {received.replay_difference * 1000:.3f} mm")
    out.print()
    out.print(f"  picture  {folder / 'demo.png'}")
    out.print(f"  log      {folder / 'raw.mcap'}")
    out.print(f"  review   companion review {folder}")
    where = _shown(view)
    if where != "off":
        from companion.view.viewer import Viewer

        viewer = Viewer(where, loaded.config.view, folder / "replay.rrd")
        if viewer.is_page:
            err.print(f"open {viewer.page}; served until Ctrl-C")
            viewer.serve_until_interrupted()


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
            help="Device string of the autopilot, /dev/ttyAMA0,921600 or udpout:host:14550 or tcp:host:5760.",
        ),
    ] = None,
    view: View = "off",
    sets: Sets = None,
) -> None:
    """Estimate live: sensors in, poses to the autopilot, everything logged. Ctrl-C ends it.

    Missing ports and a missing autopilot are waited for, and taken up again after an unplug. A pose is only
    sent while its health is ok or degraded.
    """
    from companion.config import load_config
    from companion.live import LiveRun
    from companion.mavlink.parameters import saved_settings
    from companion.shipped_files import named_file

    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    config = load_config(named_file(site, "sites"), assignments)
    if config.mavlink.parameter_file:
        saved = saved_settings(Path(config.mavlink.parameter_file))
        config = load_config(named_file(site, "sites"), [*saved, *assignments])
    folder = folder or Path("out") / datetime.now().astimezone().strftime("run-%Y%m%d-%H%M%S")
    begin = time.monotonic()

    def say(line: str) -> None:
        err.print(f"[dim]{time.monotonic() - begin:8.1f}[/]  {escape(line)}")

    with set_by_signals() as stop:
        live = LiveRun(config, folder, say, view=_shown(view))
        say(f"{config.site.name}: estimator {config.pipeline.estimator}, log {folder / 'raw.mcap'}")
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
    with progress(err) as shown:
        bar = shown.add_task(loaded.name, total=1.0)
        for share in write_log(loaded, log):
            shown.update(bar, completed=share)
        shown.update(bar, completed=1.0)
    out.print(f"{log}  {loaded.trajectory.duration:.0f} s, seed {loaded.seed}")


@app.command()
def emulate(scenario: Scenario_, seed: Seed = None, view: View = "off", sets: Sets = None) -> None:
    """Put a scenario's sensors on pseudo-terminals, in real time. Ctrl-C ends it.

    Prints the ports and the command that uses them. The robot begins to walk when the host asks for scans.
    --view shows where it truly is, and which anchors it sees.
    """
    from companion.sim.emulate import Emulator

    loaded = _load_scenario(scenario, seed, sets)
    where = _shown(view)
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
        site = _scenario_path(scenario).parent / loaded.file.site
        err.print("In another terminal:")
        err.print(f"  companion run --site {site.resolve()} {options}")
        emulator.run(stop, lambda line: err.print(line))


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
    mavlink: Annotated[
        str | None,
        typer.Option("--mavlink", metavar="URL", help="Send the poses to an autopilot, in real time."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option("--speed", min=0.1, max=10.0, metavar="X", help="With --mavlink: X times as fast."),
    ] = 1.0,
    sets: Sets = None,
) -> None:
    """Run a log through the very same decoders and estimators as live, without sleeping.

    Writes poses.tum, ranges.csv (every range with its verdict), summary.json, config.toml and replay.rrd.
    The same log and settings give the same poses, byte for byte. The settings are those stored in the log;
    change them with --set, or give a corrected site file with --site.
    """
    from companion.config import load_config
    from companion.log import Log
    from companion.replay import config_of, write_outputs
    from companion.replay import replay as run_log
    from companion.shipped_files import named_file
    from companion.tables import accuracy_table, anchor_table, sensor_lines
    from companion.view.files import RerunFiles
    from estimators import ESTIMATORS

    opened = Log(log)
    if mavlink is not None:
        sets = [*(sets or []), f"mavlink.url={mavlink}"]
    config = load_config(named_file(site, "sites"), sets or []) if site else config_of(opened, sets or [])
    names = list(dict.fromkeys(estimator or [config.pipeline.estimator]))
    for name in names:
        if name not in ESTIMATORS:
            raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    if mavlink is not None:
        _play(opened, config, names[0], speed)
        return
    folder = folder or Path("out") / log.stem
    view = RerunFiles(config, names, folder / "replay.rrd", opened.start_ns)
    begin = time.perf_counter()
    with progress(err) as shown:
        bar = shown.add_task(log.name, total=1.0)
        result = run_log(
            opened,
            config,
            names,
            view.tick,
            lambda share: shown.update(bar, completed=share),
            on_chunk=view.chunk,
        )
        view.close()
        shown.update(bar, completed=1.0)
    took = time.perf_counter() - begin
    write_outputs(result, folder)
    if not result.complete:
        err.print(f"[yellow]{log} ends abruptly (killed process or damaged file); replayed what is there[/]")
    title = f"{result.duration:.1f} s in {took:.1f} s ({result.duration / took:.0f} x real time)"
    out.print(accuracy_table(result, title + ("" if result.errors else ", no truth in the log")))
    out.print(anchor_table(result))
    for line in sensor_lines(result):
        out.print(f"  {line}")
    out.print(
        f"  written to {folder}: poses.tum, ranges.csv, summary.json, config.toml, replay.rrd",
    )


@app.command()
def plan(
    site: Annotated[
        Path, typer.Argument(metavar="SITE", help="Site file with walls, or the name of one in params/sites.")
    ],
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", metavar="NAME", help="Take furniture from the boxes of this scenario."),
    ] = None,
    limit: Annotated[
        float, typer.Option("--limit", min=0.001, metavar="M", help="Position error that is still good [m].")
    ] = 0.2,
    sigma: Annotated[
        float | None,
        typer.Option("--sigma", min=0.001, metavar="M", help="Range noise [m]; default: that of ekf."),
    ] = None,
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for plan.png.")] = Path(
        "out/plan"
    ),
    sets: Sets = None,
) -> None:
    """Say how accurate ranges can be over the floor, where they are bad, where one more anchor helps most.

    Walls and furniture block ranges, and a blocked range does not count. The error is the least that a single
    frame of ranges allows (Cramer-Rao): a filter with a LiDAR does better, nothing without memory does.
    """
    from companion.config import load_config
    from companion.plan import plan_layout
    from companion.plan_plot import plan_figure
    from companion.shipped_files import named_file
    from companion.sim.scenario import load_scenario

    config = load_config(named_file(site, "sites"), sets or [])
    world = load_scenario(_scenario_path(scenario), None, []).world if scenario else None
    layout = plan_layout(config, world, limit, sigma)
    plan_figure(layout, config, folder / "plan.png")
    for line in layout.lines():
        out.print(line, soft_wrap=True)
    out.print(f"picture  {folder / 'plan.png'}", soft_wrap=True)


@app.command("dump-config")
def dump_config(
    site: Annotated[
        Path | None, typer.Option("--site", metavar="FILE", help="Resolve this site file instead.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Print every setting with its default, or a site's whole configuration, as TOML."""
    from companion.config import default_toml, load_config
    from companion.shipped_files import named_file

    if site is None:
        if sets:
            raise UserError("--set: give --site too; the defaults alone are no configuration to change")
        sys.stdout.write(default_toml())
    else:
        sys.stdout.write(load_config(named_file(site, "sites"), sets or []).to_toml())


# Help lists commands in this order, after those above.
app.command()(review)
app.command()(smooth)
app.command("map")(make_map)
app.command()(edit)
app.command("import")(import_recording)
app.command()(export)
app.command()(sitl)
app.add_typer(doctor, name="doctor")
app.add_typer(params_app, name="params")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(evaluate_app, name="evaluate", cls=_ScenarioUnlessNamed)


def main() -> NoReturn:
    """Entry point: user errors become one line and exit code 2."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=err, show_path=False)]
    )
    try:
        app()
    except UserError as error:
        err.print("[red]error:[/]", escape(str(error)))
        sys.exit(EXIT_BAD_INPUT)
    sys.exit(0)


def _shown(view: str) -> "Shown":
    match view:
        case "web" | "native" | "off":
            return view
    raise UserError(f"--view: {view!r} is none of web, native, off")


def _scenario_path(name: str) -> Path:
    from companion.shipped_files import named_file

    return named_file(Path(name), "scenarios")


def _load_scenario(name: str, seed: int | None, sets: list[str] | None) -> "Scenario":
    from companion.sim.scenario import load_scenario

    scenario = load_scenario(_scenario_path(name), seed, sets or [])
    if scenario.file.increments is not None:
        raise UserError(
            f"{name}: a scenario with [increments] has no bytes, only `companion evaluate` runs it"
        )
    return scenario


def _play(log: "Log", config: "Config", primary: str, speed: float) -> None:
    """Send a log's poses to an autopilot and print how well it followed."""
    from companion.replay_out import Player

    player = Player(log, config, primary, speed, lambda line: err.print(line, markup=False))
    player.play()
    out.print(f"{player.poses_sent} poses sent")
    for line in player.score.lines():
        out.print(line, markup=False, soft_wrap=True)


def _report(live: "LiveRun", stop: threading.Event) -> None:
    """Show the state of a run until it stops: a status line on a terminal, else a line every 5 s."""
    if err.is_terminal:
        with err.status("starting") as status:
            while not stop.wait(0.2):
                status.update(_status_line(live.status))
    else:
        while not stop.wait(5.0):
            err.print(_status_line(live.status))


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
