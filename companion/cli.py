"""The commands. Data goes to files or stdout, progress and messages to stderr."""

import logging
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
from companion.calibrate_cli import app as calibrate_app
from companion.doctor import app as doctor
from companion.errors import UserError
from companion.evaluate_cli import app as evaluate_app
from companion.params_cli import app as params_app
from companion.review_cli import review
from companion.sitl_cli import sitl
from companion.smooth_cli import smooth

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
app.add_typer(doctor, name="doctor")
app.add_typer(params_app, name="params")
app.add_typer(calibrate_app, name="calibrate")
app.command()(sitl)
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
        help="Show it in Rerun: web (a page for a browser, see the table view), native (a window on this "
        "computer) or off. `run` shows it while it runs.",
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
    out.print(f"  review   companion review {folder}", highlight=False)
    shown = _shown(view)
    if shown != "off":
        from companion.view.viewer import Viewer

        viewer = Viewer(shown, loaded.config.view, folder / "replay.rrd")
        if viewer.is_page:
            err.print(f"open {viewer.page}; served until Ctrl-C", soft_wrap=True)
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
    from companion.config import load_config, named_file
    from companion.live import LiveRun
    from companion.mavlink.parameters import saved_settings

    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    config = load_config(named_file(site, "sites"), assignments)
    if config.mavlink.parameter_file:
        saved = saved_settings(Path(config.mavlink.parameter_file))
        config = load_config(named_file(site, "sites"), [*saved, *assignments])
    folder = folder or Path("out") / datetime.now().astimezone().strftime("run-%Y%m%d-%H%M%S")
    begin = time.monotonic()

    def say(line: str) -> None:
        err.print(f"[dim]{time.monotonic() - begin:8.1f}[/]  {escape(line)}", soft_wrap=True)

    live = LiveRun(config, folder, say, view=_shown(view))
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
    from companion.config import load_config, named_file
    from companion.log import Log
    from companion.replay import config_of, write_outputs
    from companion.replay import replay as run_log
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


@app.command("map")
def make_map(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log (MCAP) of a run, demo or simulation.")],
    out_file: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="Map (YAML) to write, with a PNG beside it.")
    ] = Path("map.yaml"),
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", metavar="NAME", help="Whose poses are used. Default: the log's."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Make a floor plan of what the LiDAR saw in a log, as a picture and a YAML file.

    The files follow the convention of the ROS map_server, which other tools read, too.
    """
    from companion.log import Log
    from companion.map_file import save_map
    from companion.mapping import survey
    from companion.replay import config_of
    from estimators import ESTIMATORS

    if out_file.suffix not in (".yaml", ".yml"):
        raise UserError(f"--out {out_file}: the name must end in .yaml")
    opened = Log(log)
    config = config_of(opened, sets or [])
    name = estimator or config.pipeline.estimator
    if name not in ESTIMATORS:
        raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    with _progress() as progress:
        bar = progress.add_task(log.name, total=1.0)
        made = survey(opened, config, name, lambda share: progress.update(bar, completed=share))
        progress.update(bar, completed=1.0)
    save_map(made.floor, out_file)
    rows, columns = made.floor.occupied.shape
    cell = made.floor.cell
    out.print(
        f"{out_file}  {columns * cell:.1f} m x {rows * cell:.1f} m in cells of {cell:g} m, "
        f"{made.inserted} of {made.scans} scans",
        highlight=False,
        soft_wrap=True,
    )


@app.command()
def edit(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log (MCAP) to read.")],
    fault: Annotated[
        list[str],
        typer.Option("--fault", metavar="KIND:KEY=VALUE,...", help="What goes wrong. Repeatable."),
    ],
    path: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log (MCAP) to write.")],
    seed: Seed = None,
) -> None:
    """Write a log as it would be had something gone wrong: what if anchor 3 dies at 20 s?

    [bold]companion edit raw.mcap --fault drop:anchor=3,at=20 --out what_if.mcap[/], then replay what_if.mcap.
    Every fault has at= and for= [s]. silent (sensor), late (sensor, by [s]), drop (anchor), spike (anchor,
    size [m], share), nlos (anchor, least, mean [m]), moved (anchor, x, y, z [m]; needs truth), clock (by [s]:
    the tag's clock jumps), rotated (yaw_deg: the tag in its mount), blocked (from_deg, to_deg, distance: a
    sector of the LiDAR), gone (share of LiDAR beams without return).
    """
    from companion.log import Log
    from companion.log_edit.edit import edit_log
    from companion.log_edit.faults import parse_fault
    from companion.replay import config_of

    opened = Log(log)
    config = config_of(opened, [])
    edit_log(opened, config, [parse_fault(text, config) for text in fault], seed or 0, path)
    out.print(f"{path}  replay it with: companion replay {path}", highlight=False, soft_wrap=True)


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
    from companion.config import load_config, named_file
    from companion.plan import plan_layout
    from companion.plan_plot import plan_figure
    from companion.sim.scenario import load_scenario

    config = load_config(named_file(site, "sites"), sets or [])
    world = load_scenario(_scenario_path(scenario), None, []).world if scenario else None
    layout = plan_layout(config, world, limit, sigma)
    plan_figure(layout, config, folder / "plan.png")
    for line in layout.lines():
        out.print(line, highlight=False, soft_wrap=True)
    out.print(f"picture  {folder / 'plan.png'}", highlight=False, soft_wrap=True)


@app.command("import")
def import_recording(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Folder of a public data set (lias_planar, labyrinth_uwb, robotino_uwb) or of text files as "
            "export writes them, CARMEN log, ROS 1 or 2 bag.",
        ),
    ],
    path: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log (MCAP) to write.")],
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file; we have one for each of the data sets."),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option("--truth", metavar="TOPIC", help="Odometry or PoseStamped of a bag to compare with."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Make a log of somebody else's recording, in the bytes that our sensors would have sent.

    Ranges become LinkTrack frames, scans RPLIDAR packets: replay and evaluate take the one path that a
    robot takes.
    """
    from companion.config import named_file
    from companion.importers.sources import import_log

    count = import_log(source, path, site and named_file(site, "sites"), sets, truth)
    out.print(f"{path}  {count} measurements", highlight=False, soft_wrap=True)


@app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log (MCAP).")],
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
) -> None:
    """Write what a log holds as text: ranges.csv, scans.csv, imu.csv, truth.tum."""
    from companion.importers.text_folder import write_folder
    from companion.log import Log
    from companion.replay import config_of

    opened = Log(log)
    for path in write_folder(opened, config_of(opened, []), folder):
        out.print(str(path), highlight=False, soft_wrap=True)


@app.command("dump-config")
def dump_config(
    site: Annotated[
        Path | None, typer.Option("--site", metavar="FILE", help="Resolve this site file instead.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Print every setting with its default, or a site's whole configuration, as TOML."""
    from companion.config import default_toml, load_config, named_file

    if site is None:
        if sets:
            raise UserError("--set: give --site too; the defaults alone are no configuration to change")
        sys.stdout.write(default_toml())
    else:
        sys.stdout.write(load_config(named_file(site, "sites"), sets or []).to_toml())


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


def _shown(view: str) -> "Shown":
    match view:
        case "web" | "native" | "off":
            return view
    raise UserError(f"--view: {view!r} is none of web, native, off")


def _scenario_path(name: str) -> Path:
    from companion.config import named_file

    return named_file(Path(name), "scenarios")


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


def _play(log: "Log", config: "Config", primary: str, speed: float) -> None:
    """Send a log's poses to an autopilot and print how well it followed."""
    from companion.replay_out import Player

    player = Player(log, config, primary, speed, lambda line: err.print(line, markup=False, soft_wrap=True))
    player.play()
    out.print(f"{player.poses_sent} poses sent", highlight=False)
    for line in player.score.lines():
        out.print(line, highlight=False, markup=False, soft_wrap=True)


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
