"""An estimator as a user names it: NAME, or NAME:PARAM with a value for its foremost setting."""

from pydantic import BaseModel

from companion.checked_toml import validated
from companion.config import Config
from companion.errors import UserError


def split_choice(choice: str) -> tuple[str, str | None]:
    """Name and parameter of NAME[:PARAM]; None when no parameter is given."""
    name, colon, parameter = choice.partition(":")
    return name, parameter if colon else None


def chosen_settings(config: Config, choice: str, option: str) -> BaseModel:
    """Settings of a chosen estimator: the site's, with the parameter in the field that it stands for.

    An estimator takes a parameter when its `Config` has a class variable `PARAMETER`, the name of a field.

    Args:
        config: of the site.
        choice: NAME[:PARAM]; NAME is a key of `ESTIMATORS`.
        option: of the command line, named in errors.

    Raises:
        UserError: the estimator takes no parameter, or not this one.
    """
    name, parameter = split_choice(choice)
    settings = config.estimator_config(name)
    if parameter is None:
        return settings
    field: str | None = getattr(type(settings), "PARAMETER", None)
    if field is None:
        raise UserError(f"{option} {choice}: {name} takes no parameter, got {parameter!r}")
    return validated(type(settings), settings.model_dump() | {field: parameter}, f"{option} {choice}")
