"""A command is a frozen dataclass: what is typed arrives in it, and identifies long work."""

from dataclasses import FrozenInstanceError, dataclass
from enum import StrEnum
from pathlib import Path

import pytest

pytest.importorskip("typer")

import typer
from typer.testing import CliRunner

from evofsm.cli.commands.common import split_names
from evofsm.cli.commands.declared import REQUIRED, Command, argument, callback, option, settings


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Plan:
    train: int = option(3, "How many.", min=1)
    inner: float = 0.5


@dataclass(frozen=True, kw_only=True)
class TwoWords(Command):
    """What the help says."""

    files: tuple[str, ...] = argument("Files.", is_setting=False)
    plan: Plan
    colour: Colour = option(Colour.RED, "Which.")
    names: tuple[str, ...] = option((), "Some.", name="--with", parse=split_names)
    unit: tuple[str, ...] | None = option(None, "Units.")
    out: Path = option(REQUIRED, "Where.", is_setting=False)
    quick: bool = option(False, "Be quick.")
    loops: bool = option(True, "Have loops.")

    def run(self) -> int | None:
        seen.append(self)
        if self.quick:
            raise ValueError("quick is\nwrong")
        return 3 if self.colour is Colour.BLUE else None


seen = []


def typed(text):
    app = typer.Typer()
    app.callback()(lambda: None)
    app.command()(callback(TwoWords))
    return CliRunner().invoke(app, ["two-words", *text.split()])


def test_what_is_typed_arrives_with_its_type():
    seen.clear()
    said = "a b --out o --train 7 --colour blue --with x,y --unit v=km/h --unit t=ms --no-loops"
    assert typed(said).exit_code == 3
    (one,) = seen
    assert one == TwoWords(
        files=("a", "b"),
        plan=Plan(train=7),
        colour=Colour.BLUE,
        names=("x", "y"),
        unit=("v=km/h", "t=ms"),
        out=Path("o"),
        loops=False,
    )
    with pytest.raises(FrozenInstanceError):
        one.quick = True


def test_what_is_not_typed_has_the_default_of_the_field():
    seen.clear()
    assert typed("a --out o").exit_code == 0
    assert seen == [TwoWords(files=("a",), plan=Plan(), out=Path("o"))]


@pytest.mark.parametrize(
    "text",
    ["a", "--out o", "a --out o --train 0", "a --out o --colour green", "a --out o --inner 1"],
)
def test_what_cannot_be_is_refused_before_anything_runs(text):
    seen.clear()
    assert typed(text).exit_code == 2
    assert not seen


def test_an_error_is_one_plain_line():
    result = typed("a --out o --quick")
    assert result.exit_code == 2
    assert result.stderr.startswith("evofsm: quick is")
    assert "Traceback" not in result.stderr


def test_a_checkpoint_goes_by_what_changes_the_result():
    one = TwoWords(files=("a",), plan=Plan(), out=Path("o"))
    assert settings(one) == {
        "train": 3,
        "colour": "red",
        "names": (),
        "unit": None,
        "quick": False,
        "loops": True,
    }


def test_checkpoints_of_learn_go_by_the_settings_that_they_always_went_by():
    from evofsm.cli.commands.learn import Learn

    assert settings(Learn(files=("a.csv",))).keys() == {
        *("observe", "action", "action_range", "time", "episode", "dt", "failed", "unit"),
        *("no_leader", "vehicle_length", "category_distance", "rule", "radius", "scale"),
        *("max_states", "distance_weight", "learning_rate", "prior_frequency", "spread"),
    }
