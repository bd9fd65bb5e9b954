"""A scorer is declared once: settings, rules, help and axes follow from its class."""

import re
import shutil

import hydra
import jax.numpy as jnp
import pytest

from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, value
from mfvpr.baselines import ALONE, SCORERS
from mfvpr.baselines.weight_registry import NAMED_WEIGHTS
from mfvpr.cli import axes, command_line, declare, groups, help_text, overrides
from mfvpr.core import match_shifts
from mfvpr.core.parameters import (
    check_plain,
    choice,
    flag,
    integer,
    number,
    numbers,
    parameters_of,
)
from mfvpr.core.types import Array, Matches
from mfvpr.core.weights import UnitWeight, Weight, match_weights, weight_field
from mfvpr.systems import assembly, settings
from mfvpr.systems.settings import CONF
from mfvpr.tuning.learning.models import can_learn, first_numbers
from tests.programs import composed

pytestmark = pytest.mark.thorough


@value
class Nearness:
    """Matches that shift by less than a radius."""

    radius: float | Array = number(30.0, "px")
    most: float | Array | None = number(None, "px", "None = all", bounds=(1, 500))
    rounds: int = integer(2, "iterations", bounds=(1, 9))
    norm: str = choice("sum", "largest", note="of x and y")
    weight: Weight = weight_field("unit")
    size: tuple[float, float] | None = numbers(None, 2, "[x, y] px", "None = any")
    strict: bool = flag(False)
    inner: tuple = ()  # no setting

    def __post_init__(self) -> None:
        check_plain(self)

    def __call__(self, matches: Matches) -> Array:
        shifts = jnp.abs(match_shifts(matches))
        length = shifts.sum(-1) if self.norm == "sum" else shifts.max(-1)
        return jnp.sum(jnp.where(length < self.radius, match_weights(self.weight, matches), 0.0))


TEXT = """\
# Made by `make conf` from mfvpr/core and mfvpr/baselines: change it there.
# A scorer is declared once: settings, rules, help and axes follow from its class.
method: near
radius: 30.0  # px
most: null  # px; null = all
rounds: 2  # iterations
norm: sum  # of x and y; sum, largest
weight: unit  # WORDS
size: null  # [x, y] px; null = any
strict: false
""".replace("WORDS", ", ".join([*NAMED_WEIGHTS, "FILE.json; a list: a scorer of each"]))


@pytest.fixture
def near(tmp_path, monkeypatch):
    """Add a scorer: its line in the table, and `make conf`."""
    monkeypatch.setitem(SCORERS, "near", Nearness)
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    declare.write_declared_files(conf)
    for module in (command_line, groups, help_text, overrides, settings):
        monkeypatch.setattr(module, "CONF", conf)
    return conf


def test_the_files_of_conf_are_those_that_follow_from_the_scores():
    texts = declare.files()
    assert {path.name for path in (CONF / "scorer").iterdir()} == {
        f"{name}.yaml" for name in (*SCORERS, *declare._VARIANTS, "paper", "all", "compared", "demo", "ratio")
    }
    for path, text in texts.items():
        assert (CONF / path).read_text(encoding="utf-8") == text, f"conf/{path} is not up to date: make conf"


def test_every_field_of_a_scorer_is_a_setting_whose_default_is_its_own():
    for scorer in SCORERS.values():
        assert [*parameters_of(scorer)] == [*scorer.__dataclass_fields__]
        assert (
            assembly.from_values(scorer, {name: parameter.default for name, parameter in parameters_of(scorer).items()})
            == scorer()
        )


def test_a_scorer_that_is_gone_leaves_no_file(near, monkeypatch):
    monkeypatch.delitem(SCORERS, "near")
    declare.write_declared_files(near)
    assert {path.name: path.read_text() for path in near.rglob("*.yaml")} == {
        path.name: path.read_text() for path in CONF.rglob("*.yaml")
    }


def test_conf_and_help_follow_from_the_class(near, succeed):
    assert (near / "scorer" / "near.yaml").read_text() == TEXT
    stdout, _ = succeed("sweep", "--help", "scorer=near")
    _, summary, *lines = TEXT.splitlines()
    for line in (summary, *lines):
        assert f"\n  {line}\n" in stdout
    assert "Made by" not in stdout
    other_names = ", ".join(sorted({path.stem for path in (near / "scorer").iterdir()} - {"near"}))
    assert f"\n  scorer=near             {other_names}\n" in re.sub(r",\n {26}", ", ", stdout)  # lines are wrapped
    assert "\n  radius: null  # near: px\n" in stdout
    assert "\n  norm: null  # near: sum, largest\n" in stdout
    assert f"\n  weight: null  # sum, anchor, histogram, near: {', '.join(NAMED_WEIGHTS)}, FILE.json\n" in stdout
    assert "\n  size: null\n" not in stdout[stdout.index("\ngrid:") :]
    assert "\n  near:\n    # A scorer" in succeed("evaluate", "--help", "scorer=all")[0]


@pytest.mark.parametrize(("program", "arguments", "words"), [
    ("evaluate", ["scorer=all", "scorer.near.radius=0"], "near.radius=0: expected a number from 1e-06"),
    ("evaluate", ["scorer=all", "scorer.near.most=501"], "near.most=501: expected a number from 1 to 500, or null"),
    ("evaluate", ["scorer=near", "scorer.rounds=10"], "scorer.rounds=10: expected a whole number from 1 to 9"),
    ("evaluate", ["scorer=near", "scorer.norm=both"], "scorer.norm=both: expected one of sum, largest"),
    ("evaluate", ["scorer=near", "scorer.weight=heavy"], " ends in .json"),
    ("evaluate", ["scorer=near", "scorer.size=[1]"], "size=[1]: expected a list of 2, each a number from 1e-06"),
    ("evaluate", ["scorer=near", "scorer.strict=1"], "scorer.strict=1: expected one of true, false"),
    ("evaluate", ["scorer=near", "scorer.method=[1]"], "scorer.method=[1]: expected one of count"),
    ("sweep", ["scorer=near", "grid.radius=[-1]"], "radius=[-1]: expected a list of one or more, each a number"),
    ("sweep", ["scorer=near", "grid.most=[null,501]"], "each a number from 1 to 500, or null"),
    ("sweep", ["scorer=near", "grid.sigma=[1]"], "radius, most, rounds"),
])  # fmt: skip
def test_rules_follow_from_the_class(near, refuse, program, arguments, words):
    assert words in refuse(program, *arguments)


def test_all_scores_contain_it(near):
    with hydra.initialize_config_dir(str(near), version_base="1.3"):
        scorers = assembly.scorers(
            hydra.compose("config", ["scorer=all", "scorer.near.size=[1,2]", "scorer.near.norm=largest"])["scorer"]
        )
    assert [*scorers] == [name for name in SCORERS if name not in ALONE]
    assert scorers["near"] == Nearness(size=(1.0, 2.0), norm="largest")
    assert scorers["near"].weight is NAMED_WEIGHTS["unit"]


def test_plain_values_become_the_fields(near):
    plain = {"radius": 3.0, "most": None, "size": [1, 2], "weight": "unit", "strict": True}
    assert assembly.from_values(Nearness, plain) == Nearness(
        3.0, None, size=(1.0, 2.0), weight=UnitWeight(), strict=True
    )
    with pytest.raises(ValueError, match=r"Nearness\(norm='both'\): .*sum, largest"):
        Nearness(norm="both")


def test_where_learning_starts_follows_from_the_fields():
    assert [name for name, scorer in SCORERS.items() if can_learn(scorer)] == ["sum", "anchor", "histogram"]
    for scorer, expected in {
        HistogramOfShifts(sigma=7.0): {"sigma": 7.0, "temperature": 0.2},  # of the spread
        AnchorPoints(temperature=0.5): {"tolerance": 3.0, "temperature": 0.5},
        AnchorPoints(): {"tolerance": 3.0, "temperature": 0.03},
        AggregatedScore(): {"temperature": 1.0},
    }.items():
        values = {name: float(jnp.exp(number)) for name, number in first_numbers(scorer, 2.0).items()}
        assert values == pytest.approx(expected)
    searched = axes.learning_axes(composed("scorer=anchor", config="learn"))
    assert {*searched.without("c").values} == {"window", "tolerance", "weight"}
