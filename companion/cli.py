"""The commands. Data goes to files or stdout, progress and messages to stderr."""

import gc
import logging
import sys
from typing import Annotated, Any, NoReturn

import typer
from rich.logging import RichHandler
from rich.markup import escape
from typer.core import TyperGroup

from companion import __version__
from companion.calibrate_cli import app as calibrate_app
from companion.doctor import app as doctor
from companion.errors import UserError
from companion.evaluate_cli import app as evaluate_app
from companion.log_cli import edit, export, import_recording, make_map
from companion.params_cli import app as params_app
from companion.replay_cli import replay
from companion.review_cli import review
from companion.run_cli import run
from companion.scenario_cli import demo, emulate, simulate
from companion.site_cli import dump_config, plan
from companion.sitl_cli import sitl
from companion.smooth_cli import smooth
from companion.terminal import flow_help, message_console, result_console

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
err = message_console()


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        result_console().print(__version__)
        raise typer.Exit


# Help lists commands in this order.
app.command()(demo)
app.command()(run)
app.command()(simulate)
app.command()(emulate)
app.command()(replay)
app.command()(plan)
app.command("dump-config")(dump_config)
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
flow_help(app)


def main() -> NoReturn:
    """Entry point: user errors become one line and exit code 2."""
    # Little here has cycles, and what a long replay keeps is looked through again and again for them.
    gc.set_threshold(20_000, 20, 20)
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=err, show_path=False)]
    )
    try:
        app()
    except UserError as error:
        err.print("[red]error:[/]", escape(str(error)))
        sys.exit(EXIT_BAD_INPUT)
    sys.exit(0)
