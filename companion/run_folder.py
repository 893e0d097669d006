"""Folders of runs: where their log is, and where what is made of it goes."""

from pathlib import Path

RAW_LOG = "raw.mcap"
"""Name of the log in the folder of a run."""


def log_in(path: Path) -> Path:
    """The log in the folder of a run; anything but a folder is one itself."""
    return path / RAW_LOG if path.is_dir() else path


def log_name(log: Path) -> str:
    """Name of a log: that of its file, or of the run that it is the log of."""
    return log.parent.resolve().name if log.name == RAW_LOG else log.stem


def folder_for(log: Path, what: str) -> Path:
    """Folder for what is made of a log."""
    return Path("out") / f"{log_name(log)}-{what}"
