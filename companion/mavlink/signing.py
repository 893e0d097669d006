"""MAVLink 2 signing: the key, and timestamps that never fall, whatever a board without a clock says.

Source: MAVLink developer guide, Message Signing.
"""

import os
import time
from pathlib import Path

from companion.errors import UserError

KEY_BYTES = 32
SAVE_PERIOD_NS = 10_000_000_000
_EPOCH = 1_420_070_400  # 2015-01-01 in seconds of UNIX time
_PER_SECOND = 100_000
_MARGIN = 20 * _PER_SECOND  # what may have been used since the last save, twice over


def read_key(path: Path) -> bytes:
    """Key of 32 bytes from a file that holds it raw or as 64 hex digits.

    Raises:
        UserError: it cannot be read, or is no key.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"mavlink.signing_key: cannot read {path}: {error.strerror}") from error
    if len(data) == KEY_BYTES:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except (UnicodeDecodeError, ValueError):
        key = b""
    if len(key) != KEY_BYTES:
        raise UserError(
            f"mavlink.signing_key: {path} holds no key: {KEY_BYTES} bytes or {2 * KEY_BYTES} hex digits, "
            f"it has {len(data)} bytes"
        )
    return key


class SigningClock:
    """Timestamps of signatures, kept beside the key from run to run.

    Args:
        key_file: path of the key.
    """

    def __init__(self, key_file: Path) -> None:
        self._path = key_file.with_name(key_file.name + ".timestamp")
        try:
            saved = int(self._path.read_text(encoding="ascii"))
        except (OSError, ValueError):
            saved = 0
        self._newest = max(saved + _MARGIN, self._wall())
        self._save_due_ns = 0

    def now(self) -> int:
        """Timestamp [10 us since 2015], higher than any before."""
        self._newest = max(self._newest + 1, self._wall())
        return self._newest

    def save(self, now_ns: int) -> None:
        """Write the newest timestamp when it is due; a file that cannot be written is no reason to stop.

        Args:
            now_ns: on the host's monotonic clock.
        """
        if now_ns < self._save_due_ns:
            return
        self._save_due_ns = now_ns + SAVE_PERIOD_NS
        draft = self._path.with_name(self._path.name + ".new")
        try:
            draft.write_text(str(self._newest), encoding="ascii")
            os.replace(draft, self._path)
        except OSError:
            return

    @staticmethod
    def _wall() -> int:
        return int((time.time() - _EPOCH) * _PER_SECOND)
