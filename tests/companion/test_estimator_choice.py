"""NAME:PARAM on the command line: the parameter reaches the setting that it stands for."""

from typing import ClassVar

import pytest
from pydantic import BaseModel, ConfigDict, Field

from companion.config import Config
from companion.errors import UserError
from companion.estimator_choice import chosen_settings, split_choice


class Swarm(BaseModel):
    """Settings of an estimator that takes a parameter."""

    PARAMETER: ClassVar[str] = "bees"

    model_config = ConfigDict(extra="forbid", frozen=True)

    bees: int = Field(30, ge=1, le=1000)
    honey: float = 0.5


@pytest.fixture
def site(config: Config, monkeypatch: pytest.MonkeyPatch) -> Config:
    """A site that has settings for a swarm, honey unlike the default."""
    of_site = Config.estimator_config
    monkeypatch.setattr(
        Config,
        "estimator_config",
        lambda self, name: Swarm(honey=0.9) if name == "swarm" else of_site(self, name),
    )
    return config


@pytest.mark.parametrize(
    ("choice", "parts"),
    [("pf", ("pf", None)), ("pf:50", ("pf", "50")), ("pf:", ("pf", "")), ("a:b:c", ("a", "b:c"))],
)
def test_a_choice_is_a_name_and_perhaps_a_parameter(choice: str, parts: tuple[str, str | None]) -> None:
    assert split_choice(choice) == parts


def test_the_parameter_goes_to_its_field_and_nothing_else_changes(site: Config) -> None:
    assert chosen_settings(site, "swarm:200", "--estimators") == Swarm(bees=200, honey=0.9)
    assert chosen_settings(site, "swarm", "--estimators") == Swarm(bees=30, honey=0.9)


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ("ekf:50", r"--estimators ekf:50: ekf takes no parameter, got '50'"),
        ("swarm:0", r"--estimators swarm:0: bees: Input should be greater than or equal to 1, got '0'"),
        ("swarm:many", r"--estimators swarm:many: bees: Input should be a valid integer.*got 'many'"),
        ("swarm:", r"--estimators swarm:: bees: Input should be a valid integer.*got ''"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_limit(site: Config, choice: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        chosen_settings(site, choice, "--estimators")
