"""`companion doctor`: what is wrong with the hardware, and what to do about it."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from companion.errors import UserError
from companion.frames_cli import frames

EXIT_NOTHING_FOUND = 1
NOTHING_THERE = """no serial port found. Check:
  - lsusb: is the adapter listed? If not: many cables only charge, try one that carries data; another socket
  - sudo dmesg | tail, right after plugging in: which driver took it, and did it stay?
  - in a container: was the device passed on (docker run --device /dev/ttyUSB0)?
  - a UART of the board itself: is it switched on (raspi-config, config.txt, device tree)?"""

app = typer.Typer(
    help="Find out what is wrong with the hardware.", no_args_is_help=True, rich_markup_mode="rich"
)
app.command()(frames)


@app.command()
def ports(
    given: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PORT]...", help="Ports to look at. Default: all serial ports there are."),
    ] = None,
    listen: Annotated[
        float | None,
        typer.Option(
            "--listen",
            min=0.1,
            max=60.0,
            metavar="SECONDS",
            help="How long to listen at each baud rate. Default: enough for what comes once a second.",
        ),
    ] = None,
) -> None:
    """Say of each serial port what speaks there, who uses it, and how to write it into the site file.

    Ports in use are left alone. All others are listened to, at every usual baud rate. Only where it stays
    silent the requests of an RPLIDAR are sent, and to a port that is no USB adapter only if it was named.

    Exit codes: 0 something was recognised, 1 nothing was, 2 the call is wrong.
    """
    from companion.port_check import check_ports, site_tables
    from drivers.discovery import LISTEN
    from drivers.port_advice import serial_ports

    for path in given or []:
        if not Path(path).is_char_device():
            there = ", ".join(port.device for port in serial_ports()) or "none at all"
            raise UserError(f"{path} is no serial port, there are: {there}")
    err = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    out = Console(highlight=False, markup=False)
    if err.is_terminal:
        with err.status("looking for ports") as status:
            findings = check_ports(given or [], listen or LISTEN, status.update)
    else:
        findings = check_ports(given or [], listen or LISTEN, err.print)
    if not findings:
        out.print(NOTHING_THERE, soft_wrap=True)
        raise typer.Exit(EXIT_NOTHING_FOUND)
    table = Table(show_lines=True)
    for heading in ("port", "USB adapter", "what speaks there"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        names = Text("\n").join([Text(finding.path), *(Text(name, "dim") for name in finding.names)])
        table.add_row(names, finding.adapter or "none", finding.text)
    out.print(table)
    if tables := site_tables(findings):
        out.print(f"\nFor the site file:\n\n{tables}", soft_wrap=True)
    if not any(finding.speaker for finding in findings):
        raise typer.Exit(EXIT_NOTHING_FOUND)
