"""TOML that users write: read, changed by `--set`, held against a model, and written again."""

import tomllib
from collections.abc import Mapping
from typing import Any, TypeVar

import tomli_w
from pydantic import BaseModel, ConfigDict, ValidationError

from companion.errors import UserError

M = TypeVar("M", bound=BaseModel)


class Table(BaseModel):
    """A table of a TOML file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def parse_toml(text: str, origin: str) -> dict[str, Any]:
    """TOML to a dictionary.

    Raises:
        UserError: not TOML, with the place of the mistake.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{origin} is not valid TOML: {error}") from error


def apply_set(data: dict[str, Any], assignment: str) -> None:
    """Apply one `--set a.b=value`; the value is read as TOML, or as text when it is none.

    Raises:
        UserError: no `=`, or the path goes through a value that is not a table.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise UserError(f"--set {assignment!r}: write key=value, for example pipeline.rate=20")
    try:
        value: Any = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *tables, key = path.strip().split(".")
    for name in tables:
        data = data.setdefault(name, {})
        if not isinstance(data, dict):
            raise UserError(f"--set {assignment!r}: {name!r} is a value, not a table")
    data[key] = value


def validated(model: type[M], data: dict[str, Any], origin: str) -> M:
    """Check data against a model.

    Raises:
        UserError: the first thing that is wrong, with key, value and limit.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first, *others = error.errors()
        key = ".".join(str(part) for part in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            reason = "unknown key"
        elif first["type"] == "missing":
            reason = "this key is required and missing"
        elif not isinstance(first["input"], dict):
            reason += f", got {first['input']!r}"
        more = f" (and {len(others)} more)" if others else ""
        raise UserError(f"{origin}: {key}: {reason}{more}") from error


def known(name: str, table: Mapping[str, Any], what: str) -> str:
    """The name, if the table has it.

    Raises:
        ValueError: it has not; names those there are.
    """
    if name not in table:
        raise ValueError(f"unknown {what} {name!r}, there are: {', '.join(table)}")
    return name


def toml_text(data: Any) -> str:
    """JSON-like data as TOML, without what TOML lacks (None, integer keys)."""
    return tomli_w.dumps(_toml_ready(data))


def _toml_ready(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _toml_ready(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_toml_ready(v) for v in value]
    return value
