"""Folders of runs: where their log is, and where what is made of it goes."""

from pathlib import Path

RAW_LOG = "raw.mcap"
"""Name of the log in the folder of a run."""


def log_in(path: Path) -> Path:
    """The log in the folder of a run; anything but a folder is one itself."""
    return path / RAW_LOG if path.is_dir() else path


def folder_for(log: Path, what: str) -> Path:
    """Folder for what is made of a log, named after it, or after the run that it is the log of."""
    name = log.resolve().parent.name if log.name == RAW_LOG else log.stem
    return Path("out") / f"{name}-{what}"
