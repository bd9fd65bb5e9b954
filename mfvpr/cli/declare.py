"""Write the files of conf/ that follow from the scorers' fields: `make conf`, or `python -m mfvpr.cli.declare`.

They are files because --help and a wrong setting must not wait for JAX.
"""

from collections.abc import Iterator, Mapping
from inspect import getmodule
from pathlib import Path
from typing import Any

import yaml

from mfvpr.baselines import ALONE, PAPER, SCORERS
from mfvpr.baselines.weight_registry import NAMED_WEIGHTS, SUFFIX
from mfvpr.core.parameters import Parameter, parameters_of
from mfvpr.systems.settings import CONF
from mfvpr.utils.files import write_text

_COUNT = "The number of matches as a score, the re-ranking of SelaVPR (Lu et al., ICLR 2024)."
_FIRST = "# Made by `make conf` from mfvpr/core and mfvpr/baselines: change it there.\n"

# Scorers with other values than their fields' defaults, by name.
_VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "homography_8": ("homography", {"threshold": 8.0}),
    "homography_24": ("homography", {"threshold": 24.0}),
    "magsac_8": ("homography_opencv", {"threshold": 8.0, "estimator": "magsac"}),
    "anchor_ratio": ("anchor", {"weight": "ratio"}),
    "histogram_ratio": ("histogram", {"weight": "ratio"}),
}


def files() -> dict[str, str]:
    """Texts by path below conf/."""
    texts = {f"scorer/{name}.yaml": "\n".join(_scorer(name)) for name in SCORERS}
    for name, (base, values) in _VARIANTS.items():
        texts[f"scorer/{name}.yaml"] = "\n".join([f"defaults: [{base}, _self_]", *_values(base, values)])
    every = [name for name in SCORERS if name not in ALONE]
    without_homography = [name for name in every if name != "homography"]
    groups = {
        "paper": ("The paper's scores, each with its parameters, and the number of matches.", PAPER),
        "all": ("Every score of any features but OpenCV's, each with the parameters of its paper.", every),
        "compared": ("Every score, and homographies as the paper has them beside MAGSAC.",
                     [*without_homography, "homography_8", "homography_24", "magsac_8"]),
        "demo": ("The paper's, and the histogram weighted by the ratio of distances (not the paper's).",
                 [*PAPER, "histogram_ratio"]),
        "ratio": ("Anchor points and histogram of shifts, matches weighted by the ratio of distances (not the "
                  "paper's).", ["anchor_ratio@anchor", "histogram_ratio@histogram"]),
    }  # fmt: skip
    for name, (about, members) in groups.items():
        entries = (f"  - {member}" if "@" in member else f"  - {member}@{member}" for member in members)
        texts[f"scorer/{name}.yaml"] = "\n".join([f"# {about}", "defaults:", *entries])
    texts["axes.yaml"] = "\n".join(_axes())
    limits = {
        name: {field: _limits(field, parameter) for field, parameter in parameters_of(scorer).items()}
        for name, scorer in SCORERS.items()
    }
    texts["rules.yaml"] = yaml.safe_dump(limits, sort_keys=False, default_flow_style=None).strip()
    return {path: f"{_FIRST}{text}\n" for path, text in texts.items()}


def write_declared_files(conf: Path) -> None:
    """Write all files, and remove the files of other scorers."""
    texts = {conf / path: text for path, text in files().items()}
    for path, text in texts.items():
        write_text(path, text)
    for path in {*(conf / "scorer").glob("*.yaml")} - texts.keys():
        path.unlink()


def _scorer(method: str) -> Iterator[str]:
    of_module = (getmodule(SCORERS[method]).__doc__ or method).splitlines()[0]
    yield f"# {_COUNT if method == 'count' else of_module}"
    yield f"method: {method}"
    yield from _values(method, {name: field.default for name, field in parameters_of(SCORERS[method]).items()})


def _values(method: str, values: Mapping[str, Any]) -> Iterator[str]:
    """Lines of some of a scorer's parameters."""
    for name, value in values.items():
        field = parameters_of(SCORERS[method])[name]
        of_a_list = "a list: a scorer of each" if name == "weight" else ""
        yield _line(name, value, "; ".join(filter(None, (field.unit, field.note, _words(name, field), of_a_list))))


def _limits(name: str, parameter: Parameter) -> dict[str, Any]:
    """Limits of a plain value, themselves plain, by name; limits that are not set are left out."""
    kind = "choices" if parameter.choices else "whole" if parameter.whole else "number"
    choices = [*NAMED_WEIGHTS] if name == "weight" else list(parameter.choices)
    limits = {kind: choices or list(parameter.bounds), "length": parameter.length}
    limits |= {"optional": parameter.default is None, "file": SUFFIX if name == "weight" else ""}
    return {name: limit for name, limit in limits.items() if limit}


def _words(name: str, parameter: Parameter) -> str:
    """The choices that are words, separated by commas."""
    if name == "weight":
        return ", ".join([*NAMED_WEIGHTS, f"FILE{SUFFIX}"])
    return ", ".join(word for word in parameter.choices if isinstance(word, str))


def _axes() -> Iterator[str]:
    """Lines of the parameters that can be swept: of one scorer each, then those that several scorers share."""
    owners: dict[str, dict[str, str]] = {}
    for name, scorer in SCORERS.items():
        for field, parameter in parameters_of(scorer).items():
            if parameter.swept:
                owners.setdefault(field, {})[name] = parameter.unit or _words(field, parameter)
    yield "grid:  # lists of values of the scorer's parameters; null = its own value"
    for field, units in sorted(owners.items(), key=lambda item: len(item[1]) > 1):
        [unit, *more] = {*units.values()}
        yield _line(f"  {field}", None, ", ".join(units) + (f": {unit}" if unit and not more else ""))


def _line(name: str, default: Any, comment: str) -> str:
    value = yaml.safe_dump(default, default_flow_style=True).splitlines()[0]
    return f"{name}: {value}" + (f"  # {comment}" if comment else "").replace("None", "null")


if __name__ == "__main__":
    write_declared_files(CONF)
