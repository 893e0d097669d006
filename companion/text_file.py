"""Text files that the user named."""

from pathlib import Path

from companion.errors import UserError


def read_text(path: Path) -> str:
    """Text of a file the user named.

    Raises:
        UserError: it cannot be read, or is not text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file: {error.reason} at byte {error.start}") from error
