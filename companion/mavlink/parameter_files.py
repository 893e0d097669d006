"""Files with parameters of an autopilot: ArduPilot's `.parm` and QGroundControl's `.params` for PX4."""

from dataclasses import dataclass
from pathlib import Path

from companion.errors import UserError
from companion.shipped_files import params_dir
from companion.text_file import read_text

FOLDERS = {"ardupilot": ".parm", "px4": ".params"}
"""Autopilot -> ending of its files; ours are in a folder of that name."""
OLD_NAMES = "-4.6"
"""Ends the name of a file with the names that ArduPilot used before 4.7."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of a file.

    Attributes:
        name: of the parameter.
        value: wanted.
        why: the comment above it; empty when there is none.
    """

    name: str
    value: float
    why: str = ""


def read_settings(path: Path) -> list[Setting]:
    """Settings of a file in either format.

    Raises:
        UserError: it cannot be read, or a line of it.
    """
    settings: list[Setting] = []
    why = ""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if not text:
            why = ""
        elif text.startswith("#"):
            why = f"{why} {text.lstrip('# ')}".strip()
        else:
            words = text.split("#")[0].replace(",", " ").split()
            name, value = words[2:4] if path.suffix == ".params" and len(words) == 5 else (*words, "", "")[:2]
            try:
                settings.append(Setting(name, float(value), why))
            except ValueError as error:
                raise UserError(f"{path}: line {number} is no parameter: {line!r}") from error
            why = ""
    return settings


def write_settings(path: Path, settings: list[Setting], title: str) -> None:
    """Write a `.parm` file.

    Raises:
        UserError: it cannot be written.
    """
    lines = [f"# {title}", "", *(f"{setting.name} {setting.value:.9g}" for setting in settings)]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def settings_file(name: str, autopilot: str) -> Path:
    """A file of the user's, or one of ours for the autopilot by its bare name.

    Args:
        name: path, or a name such as `uwb_lidar`.
        autopilot: `ardupilot` or `px4`.

    Raises:
        UserError: there is none; names those there are.
    """
    if Path(name).is_file():
        return Path(name)
    folder, ending = params_dir() / autopilot, FOLDERS[autopilot]
    path = folder / f"{name}{ending}"
    if not path.is_file():
        there = ", ".join(sorted(p.stem for p in folder.glob(f"*{ending}") if not p.stem.endswith(OLD_NAMES)))
        raise UserError(f"{name}: no such file, and none of ours for {autopilot}; there are: {there}")
    return path
