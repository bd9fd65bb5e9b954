"""Writes the files of conf/ that follow from the fields of the scores: `make conf`, or `python -m experiments.declare`.

They are files, not made when a program starts, because --help and a wrong setting must not wait for JAX.
"""

from collections.abc import Iterator
from inspect import getmodule
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

from experiments.settings import CONF
from mfvpr.data.files import write_text
from mfvpr.declaration import Parameter, declared
from mfvpr.scoring import SCORERS


def files() -> dict[str, str]:
    """Texts by path below conf/."""
    made = {f"scorer/{name}.yaml": _scorer(name, scorer) for name, scorer in SCORERS.items()}
    every = "".join(f"  - {name}@{name}\n" for name in SCORERS)
    made["scorer/all.yaml"] = f"# Every score, each with the paper's parameters.\ndefaults:\n{every}"
    made["axes.yaml"] = "\n".join(_axes())
    rules = {name: {field: _rule(one) for field, one in declared(scorer).items()} for name, scorer in SCORERS.items()}
    made["rules.yaml"] = yaml.safe_dump(rules, sort_keys=False, default_flow_style=None, width=120)
    return {path: f"# Made by `make conf` from mfvpr/scoring: change it there.\n{text}" for path, text in made.items()}


def write(conf: Path) -> None:
    """All of them, and no other scorer."""
    made = files()
    for path, text in made.items():
        write_text(conf / path, text)
    for path in {*(conf / "scorer").glob("*.yaml")} - {conf / path for path in made}:
        path.unlink()


def _scorer(name: str, scorer: type) -> str:
    lines = [_line(field, one.default, [one.unit, one.note, _words(one)]) for field, one in declared(scorer).items()]
    return "\n".join([f"# {_summary(scorer)}", f"method: {name}", *lines, ""])


def _axes() -> Iterator[str]:
    """Parameters of one scorer, scorer by scorer; then those that several have."""
    owners: dict[str, dict[str, Parameter]] = {}
    for name, scorer in SCORERS.items():
        for field, one in declared(scorer).items():
            if one.swept:
                owners.setdefault(field, {})[name] = one
    yield "grid:  # lists of values of the scorer's parameters; null = its own value"
    for field, by_scorer in sorted(owners.items(), key=lambda item: len(item[1]) > 1):
        comments = [(name, ", ".join(filter(None, (one.unit, _words(one))))) for name, one in by_scorer.items()]
        alike = [(comment, ", ".join(name for name, _ in same)) for comment, same in groupby(comments, lambda c: c[1])]
        yield _line(f"  {field}", None, [f"{names}: {comment}" if comment else names for comment, names in alike])
    yield ""


def _line(name: str, default: Any, comments: list[str]) -> str:
    comment = "; ".join(filter(None, comments)).replace("None", "null")
    value = yaml.safe_dump(default, default_flow_style=True).removesuffix("...\n").strip()
    return f"{name}: {value}" + (f"  # {comment}" if comment else "")


def _words(one: Parameter) -> str:
    return ", ".join(one.choices) if one.choices != (True, False) else ""


def _summary(scorer: type) -> str:
    """First line of the scorer's module."""
    return (getattr(getmodule(scorer), "__doc__", None) or scorer.__name__).splitlines()[0]


def _rule(one: Parameter) -> dict[str, Any]:
    """What `experiments.settings` makes a rule of."""
    kind = "choices" if one.choices else "whole" if one.whole else "number"
    rule = {kind: list(one.choices or one.bounds), "length": one.length, "optional": one.optional}
    return {name: value for name, value in rule.items() if value}


if __name__ == "__main__":
    write(CONF)
