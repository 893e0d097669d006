"""Our settings as MAVLink parameters, so that a pilot can tune us from a ground station.

Every value is a REAL32, whatever it is in the configuration: ground stations differ in how they pack
integers. Bounds are those of the configuration. A write that is refused is answered with the old value.

Source: MAVLink developer guide, Parameter Protocol.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config, config_from_toml
from companion.errors import UserError
from drivers.mavlink_frames import MavlinkMessage
from estimators import ESTIMATORS

ALIGN = "ALIGN_COMPASS"
LIST_SHARE = 0.4
"""Share of the link that the list of all parameters may take."""
_FRAME_BYTES = 50  # a signed PARAM_VALUE
_AT_ONCE = ("health.", "mavlink.gate.", "mavlink.height", "site.map_heading_deg")
"""What concerns the output alone; the rest would change poses that a replay of the log must give again."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter.

    Attributes:
        name: at most 16 characters.
        path: of the setting, as in `--set`.
        index: of the number in a setting that is a list; None = it is one number.
    """

    name: str
    path: str
    index: int | None = None

    @property
    def applies_at_once(self) -> bool:
        """Whether a change is used in this run; otherwise from the next start on."""
        return self.path.startswith(_AT_ONCE)


_FIXED = (
    Parameter("HLT_SIGMA_XY", "health.max_sigma_xy"),
    Parameter("HLT_SIGMA_YAW", "health.max_sigma_yaw_deg"),
    Parameter("HLT_RANGE_AGE", "health.max_range_age"),
    Parameter("HLT_INCR_AGE", "health.max_increment_age"),
    Parameter("HLT_DEAD_RECK", "health.max_dead_reckoning"),
    Parameter("HLT_MIN_SHARE", "health.min_accepted_share"),
    Parameter("HLT_MAX_SHORT", "health.max_short_share"),
    Parameter("GATE_RESUME", "mavlink.gate.resume_after"),
    Parameter("GATE_JUMP", "mavlink.gate.max_jump"),
    Parameter("GATE_JUMP_YAW", "mavlink.gate.max_jump_deg"),
    Parameter("GATE_SPEED", "mavlink.gate.max_speed"),
    Parameter("GATE_TURN_RATE", "mavlink.gate.max_turn_rate_deg"),
    Parameter("OUT_HEADING", "mavlink.heading"),
    Parameter("OUT_HEIGHT", "mavlink.height"),
    Parameter("OUT_OBSTACLES", "mavlink.obstacles"),
    Parameter("OUT_RATE", "pipeline.rate"),
    Parameter("MAP_HEADING", "site.map_heading_deg"),
    Parameter("BODY_HEIGHT", "body.height"),
    Parameter("TAG_X", "body.tag", 0),
    Parameter("TAG_Y", "body.tag", 1),
    Parameter("TAG_Z", "body.tag", 2),
    Parameter("LIDAR_X", "body.lidar", 0),
    Parameter("LIDAR_Y", "body.lidar", 1),
    Parameter("LIDAR_YAW", "body.lidar_yaw_deg"),
    Parameter("START_X", "start.x"),
    Parameter("START_Y", "start.y"),
    Parameter("START_YAW", "start.yaw_deg"),
    Parameter("SCAN_INLIERS", "scan_matcher.min_inlier_share"),
)
_OF_THE_ESTIMATOR = {
    "EST_RANGE_SIGMA": "range_sigma",
    "EST_RANGE_GATE": "range_gate",
    "EST_INCR_GATE": "increment_gate",
    "EST_ACCEL": "accel_noise",
    "NLOS_EXCESS": "nlos_excess",
    "NLOS_MEMORY": "nlos_memory",
    "NLOS_POWER": "nlos_power",
    "NLOS_OBST_HGT": "obstacle_height",
}
_CHOICE = Parameter("EST_CHOICE", "pipeline.estimator")


class ParameterServer:
    """Answers the parameter protocol; free of I/O.

    Args:
        config: whose settings these are.
        changed: told of every accepted write: the parameter, and the configuration with it.
        align: starts the alignment to the compass, or says why it cannot be done.
    """

    def __init__(
        self, config: Config, changed: Callable[[Parameter, Config], None], align: Callable[[], None]
    ) -> None:
        self._config = config
        self._changed = changed
        self._align = align
        chosen = config.pipeline.estimator
        has = type(config.estimator_config(chosen)).model_fields
        tuned = [
            Parameter(name, f"estimator.{chosen}.{key}")
            for name, key in _OF_THE_ESTIMATOR.items()
            if key in has
        ]
        # A start that is not known has no coordinates.
        given = [p for p in (*_FIXED, _CHOICE, *tuned) if _setting(config, p) is not None]
        self._table = {p.name: p for p in given}
        # Neither the set nor the order may change after the first answer.
        self._names = [*self._table, ALIGN]
        self._listed = len(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def value(self, name: str) -> float:
        """Value of a parameter as it goes over the wire."""
        if name == ALIGN:
            return 0.0
        parameter = self._table[name]
        setting = _setting(self._config, parameter)
        return float(list(ESTIMATORS).index(setting) if parameter is _CHOICE else setting)

    def receive(self, message: MavlinkMessage) -> list[MavlinkMessage]:
        """Answers to a message that is addressed to our component."""
        match message.get_type():
            case "PARAM_REQUEST_LIST":
                self._listed = 0
            case "PARAM_REQUEST_READ":
                if 0 <= message.param_index < len(self._names):
                    return [self._report(self._names[message.param_index])]
                if message.param_index == -1 and message.param_id in self._names:
                    return [self._report(message.param_id)]
            case "PARAM_SET" if message.param_id in self._names:
                if message.param_type == mavlink2.MAV_PARAM_TYPE_REAL32:
                    self._set(message.param_id, message.param_value)
                return [self._report(message.param_id)]
        return []

    def poll(self, bytes_per_second: float, dt: float) -> list[MavlinkMessage]:
        """The next few of a list that was asked for.

        Args:
            bytes_per_second: capacity of the link.
            dt: time since the last call [s].
        """
        count = max(1, int(LIST_SHARE * bytes_per_second * dt / _FRAME_BYTES))
        names = self._names[self._listed : self._listed + count]
        self._listed += len(names)
        return [self._report(name) for name in names]

    def _set(self, name: str, value: float) -> None:
        if name == ALIGN:
            if value == 1.0:
                self._align()
            return
        if not isfinite(value):
            return
        parameter = self._table[name]
        # What was typed, not its float32 neighbour.
        typed = float(f"{value:.7g}")
        before = _setting(self._config, parameter)
        literal = _literal(self._config, parameter, before, typed)
        if literal is None:
            return
        try:
            config = config_from_toml(self._config.to_toml(), "parameter", [f"{parameter.path}={literal}"])
        except UserError:
            return
        if _setting(config, parameter) != before:
            self._config = config
            self._changed(parameter, config)

    def _report(self, name: str) -> MavlinkMessage:
        return mavlink2.MAVLink_param_value_message(
            name.encode(),
            self.value(name),
            mavlink2.MAV_PARAM_TYPE_REAL32,
            len(self._names),
            self._names.index(name),
        )


def _setting(config: Config, parameter: Parameter) -> Any:
    value: Any = config
    for key in parameter.path.split("."):
        value = getattr(value, key)
    return value if parameter.index is None else value[parameter.index]


def _literal(config: Config, parameter: Parameter, before: Any, typed: float) -> str | None:
    """The whole setting as TOML; None when the number does not fit its type."""
    if parameter is _CHOICE:
        names = list(ESTIMATORS)
        return repr(names[int(typed)]) if typed.is_integer() and 0 <= typed < len(names) else None
    if isinstance(before, bool):
        return {0.0: "false", 1.0: "true"}.get(typed)
    if isinstance(before, int):
        return str(int(typed)) if typed.is_integer() else None
    if parameter.index is None:
        return repr(typed)
    whole = list(_setting(config, Parameter(parameter.name, parameter.path)))
    whole[parameter.index] = typed
    return repr(whole)


def setting_line(parameter: Parameter, config: Config) -> str:
    """The whole setting that a parameter belongs to, as `--set` takes it."""
    value = _setting(config, Parameter(parameter.name, parameter.path))
    if isinstance(value, bool):
        return f"{parameter.path}={str(value).lower()}"
    return f"{parameter.path}={list(value) if isinstance(value, tuple) else repr(value)}"


def saved_settings(path: Path) -> list[str]:
    """Settings that a ground station has changed in earlier runs, as `--set` takes them.

    Raises:
        UserError: the file is there and cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"mavlink.parameter_file: cannot read {path}: {error}") from error
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def save_setting(path: Path, line: str) -> None:
    """Add or replace one setting in the file.

    Raises:
        UserError: it cannot be written.
    """
    key = line.partition("=")[0]
    kept = [old for old in saved_settings(path) if old.partition("=")[0].strip() != key]
    text = "\n".join(["# written by companion when a ground station sets a parameter", *kept, line])
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"mavlink.parameter_file: cannot write {path}: {error.strerror}") from error
