"""Parameters of autopilots that have changed their names, and some their meaning, between versions.

Source: ArduPilot wiki, parameter name changes of 4.6 and 4.7.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

_EVERY_CHECK = 1
"""Value of ARMING_CHECK that stands for all of its bits."""
_ALL_SKIPPED = -1.0


@dataclass(frozen=True, slots=True)
class Alias:
    """Another name of a parameter.

    Attributes:
        name: the other name.
        convert: value under the one name to that under the other.
    """

    name: str
    convert: Callable[[float], float]


def _same(value: float) -> float:
    return value


def _checks_to_skips(value: float) -> float:
    """ARMING_CHECK names what is checked, ARMING_SKIPCHK what is not."""
    if int(value) & _EVERY_CHECK:
        return 0.0
    return _ALL_SKIPPED if value == 0.0 else float(~int(value) & 0x7FFFFE)


def _skips_to_checks(value: float) -> float:
    if value == 0.0:
        return float(_EVERY_CHECK)
    return 0.0 if value == _ALL_SKIPPED else float(~int(value) & 0x7FFFFE)


_RENAMED = (
    ("SYSID_THISMAV", "MAV_SYSID"),
    ("SYSID_MYGCS", "MAV_GCS_SYSID"),
    ("GPS_TYPE", "GPS1_TYPE"),
    ("GPS_TYPE2", "GPS2_TYPE"),
)
_STREAM = re.compile(r"SR(\d)_(\w+)")
_NEW_STREAM = re.compile(r"MAV(\d)_((?:RAW_|EXT_|RC_|POS|EXTRA|PARAMS|ADSB)\w*)")
_RANGE_CM = re.compile(r"RNGFND(\w)_(MIN|MAX)_CM")
_RANGE_M = re.compile(r"RNGFND(\w)_(MIN|MAX)")


def aliases(name: str) -> Iterator[Alias]:
    """Other names under which an autopilot may know a parameter; newer and older ones."""
    for old, new in _RENAMED:
        if name in (old, new):
            yield Alias(new if name == old else old, _same)
    if name == "ARMING_CHECK":
        yield Alias("ARMING_SKIPCHK", _checks_to_skips)
    elif name == "ARMING_SKIPCHK":
        yield Alias("ARMING_CHECK", _skips_to_checks)
    elif match := _STREAM.fullmatch(name):
        yield Alias(f"MAV{int(match[1]) + 1}_{match[2]}", _same)
    elif (match := _NEW_STREAM.fullmatch(name)) and match[1] != "0":
        yield Alias(f"SR{int(match[1]) - 1}_{match[2]}", _same)
    elif match := _RANGE_CM.fullmatch(name):
        yield Alias(f"RNGFND{match[1]}_{match[2]}", lambda value: value / 100.0)
    elif match := _RANGE_M.fullmatch(name):
        yield Alias(f"RNGFND{match[1]}_{match[2]}_CM", lambda value: value * 100.0)
