"""Key files, and timestamps that never fall from run to run."""

from pathlib import Path

import pytest

from companion.errors import UserError
from companion.mavlink.signing import SigningClock, read_key

KEY = bytes(range(32))
YEAR_2026 = 1_790_000_000.0


@pytest.mark.parametrize("content", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_raw_or_in_hex(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    assert read_key(path) == KEY


@pytest.mark.parametrize("content", [b"", b"short", KEY + b"x", b"zz" * 32])
def test_what_is_no_key_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    with pytest.raises(
        UserError, match=f"holds no key: 32 bytes or 64 hex digits, it has {len(content)} bytes"
    ):
        read_key(path)
    with pytest.raises(UserError, match="cannot read"):
        read_key(tmp_path / "none")


def test_timestamps_rise_over_restarts_on_a_board_without_a_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "key"
    now = YEAR_2026
    monkeypatch.setattr("time.time", lambda: now)
    first = SigningClock(path)
    stamps = [first.now() for _ in range(100)]
    assert stamps == sorted(set(stamps))
    # 10 us since 2015.
    assert stamps[0] == pytest.approx((YEAR_2026 - 1_420_070_400) * 1e5, abs=2)
    first.save(0)
    now += 9.0
    newest = first.now()
    first.save(9_000_000_000)
    # Killed before the next save, and started again in 1970.
    now = 100.0
    assert SigningClock(path).now() > newest


def test_a_folder_that_cannot_be_written_is_no_reason_to_stop(tmp_path: Path) -> None:
    clock = SigningClock(tmp_path / "none" / "key")
    clock.save(0)
    assert clock.now() > 0
