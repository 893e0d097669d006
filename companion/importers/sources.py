"""Which of the formats a file or folder is in, and the log that is made of it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from companion.config import Config, load_config
from companion.errors import UserError
from companion.importers.carmen import read_carmen
from companion.importers.data_sets import DATA_SETS, data_set_in
from companion.importers.recording import Recording, write_recording
from companion.importers.ros import read_bag
from companion.importers.text_folder import INERTIAL, RANGES, SCANS, read_folder
from companion.shipped_files import params_dir

_CARMEN = (".log", ".clf")
_BAGS = (".bag", ".mcap", ".db3")
_ROS2_FOLDER = "metadata.yaml"


def import_log(
    source: Path,
    path: Path,
    site: Path | None = None,
    sets: list[str] | None = None,
    truth: str | None = None,
) -> int:
    """Make a log of a recording.

    Args:
        source: folder of a data set or of text files, CARMEN log, ROS bag.
        path: log to write.
        site: site file; may be left out for the data sets that we have one for.
        sets: `--set` assignments on it.
        truth: topic of the reference in a ROS bag.

    Returns:
        Number of measurements in the log.

    Raises:
        UserError: the format is none of these, the site is missing, or something in it is wrong.
    """
    name = data_set_in(source) if source.is_dir() else None
    read = _reader(source, name, truth)
    if site is None:
        if name is None:
            raise UserError(f"{source}: give --site FILE, the recording does not say where its anchors stand")
        site = params_dir() / "sites" / f"{name}.toml"
    config = load_config(site, sets or [])
    return write_recording(read(config), config, path)


def _reader(source: Path, name: str | None, truth: str | None) -> Callable[[Config], Recording]:
    if not source.exists():
        raise UserError(f"cannot read {source}: No such file or directory")
    if name is not None:
        return partial(DATA_SETS[name][1], source)
    if source.suffix in _CARMEN:
        return lambda _: read_carmen(source)
    if source.suffix in _BAGS or (source / _ROS2_FOLDER).exists():
        return lambda _: read_bag(source, truth)
    if any((source / file).exists() for file in (RANGES, SCANS, INERTIAL)):
        return lambda _: read_folder(source)
    raise UserError(
        f"{source}: neither a data set that is known ({', '.join(DATA_SETS)}), a folder with {RANGES}, "
        f"{SCANS} or {INERTIAL}, a CARMEN log ({', '.join(_CARMEN)}) nor a ROS bag ({', '.join(_BAGS)})"
    )
