"""Checks every setting before any work, and before anything slow is imported.

Hydra knows which settings exist and of which type the file had them; what a value means is known here.
"""

import math
import numbers
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

CONF = Path(__file__).parent.parent / "conf"

Program = Callable[[], Callable[[dict[str, Any]], None]]  # imports the job, which takes a while, and returns it


class SettingsError(Exception):
    """A setting that cannot be used; one line that names it, what was expected, and what was got."""


class Rule(NamedTuple):
    """What a setting must be, in code and in words."""

    holds: Callable[[Any], bool]
    expected: str


def _is_number(value: Any) -> bool:
    if isinstance(value, bool):
        return False
    return isinstance(value, int) or (isinstance(value, numbers.Real) and math.isfinite(value))


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _one_of(*choices: Any) -> Rule:
    return Rule(lambda value: any(value is c or (value == c and type(value) is type(c)) for c in choices),
                "one of " + ", ".join("null" if c is None else str(c).lower() if isinstance(c, bool) else str(c)
                                      for c in choices))  # fmt: skip


def _or(rule: Rule, *choices: Any) -> Rule:
    other = _one_of(*choices)
    words = other.expected.removeprefix("one of ")
    return Rule(lambda value: rule.holds(value) or other.holds(value), f"{rule.expected}, or {words}")


def _list_of(rule: Rule, length: int = 0) -> Rule:
    def holds(value: Any) -> bool:
        return (
            isinstance(value, list)
            and (len(value) == length if length else bool(value))
            and all(map(rule.holds, value))
        )

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def _number(low: float, high: float) -> Rule:
    words = {
        (1e-6, 1e12): "a number above 0 (1e-6 to 1e12)",
        (1e-6, 2): "a number above 0 and at most 2",
        (0, 1e12): "a number not below 0 (at most 1e12)",
    }.get((low, high), f"a number from {low:g} to {high:g}")
    return Rule(lambda value: _is_number(value) and low <= value <= high, words)


def _between(low: int, high: int) -> Rule:
    return Rule(lambda value: _is_count(value) and low <= value <= high, f"a whole number from {low} to {high}")


MAX_SHOWN = 200  # characters of a value that is refused
# Beyond these bounds float32 and int32 would fail, without a word.
_POSITIVE = _number(1e-6, 1e12)
_NOT_NEGATIVE = _number(0, 1e12)
_COUNT = Rule(lambda value: _is_count(value) and 0 < value <= 10**6, "a whole number above 0 (at most 1000000)")
_INDEX = Rule(lambda value: _is_count(value) and 0 <= value <= 10**6, "a whole number not below 0 (at most 1000000)")
_SIDE = _between(16, 4096)
_DISTANCE = _number(1e-6, 2)
_TEXT = Rule(lambda value: isinstance(value, str) and bool(value), "text")
_PATH = Rule(
    lambda value: isinstance(value, str) and bool(value) and "${" not in value,
    "a path, with names of variables filled in (double quotes let the shell do that)",
)
_QUERY = Rule(lambda value: _INDEX.holds(value) or _TEXT.holds(value), "a row or a name of a query")
_FIGURES = Rule(
    lambda value: _INDEX.holds(value) or _list_of(_QUERY).holds(value),
    "how many (at most 1000000), or a list of rows or names of queries",
)
_FLAG = _one_of(True, False)


def _or_list(rule: Rule) -> Rule:
    listed = _list_of(rule)
    return Rule(lambda value: rule.holds(value) or listed.holds(value), f"{rule.expected}, or a list of them")


def _axis(rule: Rule) -> Rule:
    listed = _list_of(rule)
    return Rule(
        lambda value: value is None or listed.holds(value), f"{listed.expected}; null is the scorer's own value"
    )


RULES: dict[str, Rule] = {
    "dataset.name": Rule(
        lambda value: isinstance(value, str) and bool(re.fullmatch(r"[\w-][\w.-]*", value)), "letters, digits, - and _"
    ),
    "features.name": _one_of("sift", "d2net", "aliked", "ssm", "import"),
    "retrieval.name": _one_of("vlad", "mixvpr", "ssm", "import", "pairs"),
    "features.image_size": _or(_list_of(_SIDE, 2), None),
    # data
    "seed": _INDEX,
    "cache": _PATH,
    "root": _PATH,
    "database": _PATH,
    "queries": _or_list(_PATH),
    "ground_truth": _one_of(None, "order", "index", "utm", "label", "none"),  # None: asked for, see build.dataset
    "index_file": _or(_PATH, None),
    "widen_index": _FLAG,
    "lengths": _one_of("unit", "normalize", "keep"),
    "database_prefix": _or(_TEXT, ""),
    "query_prefix": _or(_TEXT, ""),
    "database_labels": _or(_PATH, None),
    "query_labels": _or(_PATH, None),
    "exclude_neighbors": _or(_INDEX, None),
    "orient": _FLAG,
    "bits": _or(_between(8, 16), None),
    # features and filter
    "image_size": _list_of(_SIDE, 2),
    "interpolation": _one_of("pil_bilinear", "pil_bicubic", "cv2_linear", "cv2_area", "cv2_cubic", "torch_bilinear"),
    "weights": _TEXT,
    "preprocessing": _one_of("caffe", "torch"),
    "multiscale": _FLAG,
    "threshold": _NOT_NEGATIVE,
    "max_keypoints": _or(_between(1, 20_000), None),
    "batch_size": _between(1, 256),
    "contrast_threshold": _POSITIVE,
    "clahe_clip": _NOT_NEGATIVE,
    "num_words": _between(1, 4096),
    "power": _POSITIVE,
    "max_samples": _COUNT,
    "whiten": _or(_between(1, 4096), None),
    "dimension": _between(1, 4096),
    "max_images": _or(_COUNT, None),
    "max_windows": _or(_COUNT, None),
    "zero_row": _FLAG,
    "stride": _between(1, 8),
    "candidates": _or(_COUNT, "all"),
    "memory": _or(_POSITIVE, None),
    "devices": _or(_COUNT, "all"),
    # matching
    "matching.name": _one_of("neighbors", "lightglue"),
    "filter_threshold": _number(0, 1),
    "depth_confidence": _or(_number(0, 1), None),
    "cross_check": _one_of("mutual", "opencv_legacy", "none", "candidate"),
    "max_distance": _or(_DISTANCE, None),
    "max_matches": _or(_COUNT, None),
    "chunk_size": _or(_COUNT, None),
    # scores, besides those of each scorer
    "filter_score": _one_of("cosine", "negative_euclidean"),
    "ties": _one_of("filter", "index"),
    "c": _or(_NOT_NEGATIVE, "auto"),
    "fusion.c": _or(_NOT_NEGATIVE, "auto", "zscore"),
    "fusion.weights": Rule(lambda value: value is None, "weights by name, such as {filter: 0.5, anchor: 1}, or null"),
    "final": _one_of("score", "combined"),
    "previous_queries": _between(0, 1000),
    ".confidence": _or(_PATH, None),
    ".threshold": _or(_number(0, 1), None),
    # report
    "tolerances": _list_of(_INDEX),
    "radius": _POSITIVE,
    "ks": _list_of(_COUNT),
    "store": _or(_PATH, None),
    "on_bad_image": _one_of("fail", "skip"),
    "figures": _FIGURES,
    "out": _or(_PATH, None),
    # sweeps
    "search": _one_of("grid", "optuna"),
    "trials": _between(1, 100_000),
    "split": _one_of(None, "first_half", "second_half", "both"),
    # learning
    "loss": _one_of("cross_entropy", "recall", "average_precision"),
    "steps": _COUNT,
    "every": _COUNT,
    "patience": _COUNT,
    "batch": _between(1, 1024),
    "learning_rate": _POSITIVE,
    "hidden": _between(1, 1024),
    "checkpoints": _or(_PATH, None),
    "chunk.settings": _or(_COUNT, None),
    "chunk.queries": _or(_COUNT, None),
}


def check(settings: Mapping[str, Any]) -> None:
    """Raise a SettingsError for the first value that its rule does not allow."""
    scorer = settings.get("scorer", {})
    method = str(scorer.get("method") or "")  # "" of several
    methods = {name: str(one.get("method")) for name, one in scorer.items() if isinstance(one, Mapping)}
    for path, value in _leaves(settings, ""):
        rule = _rule(path, methods | {"scorer": method})
        if rule is None and method and path.startswith("scorer."):
            raise SettingsError(f"scorer={method} has no setting {path.removeprefix('scorer.')}; see --help")
        if rule is None:
            raise SettingsError(f"{path}={value}: this is a group of settings; set one of its members (see --help)")
        if not rule.holds(value):
            raise SettingsError(f"{path}={_shown(value)}: expected {rule.expected}")
    _check_vocabulary(settings.get("retrieval", {}))
    features = settings.get("features", {})
    if features.get("name") == "ssm" and features["image_size"] is None:
        raise SettingsError("features.image_size=null: expected width and height for features=ssm, such as [336,336]")
    if method == "grid":
        _check_cells(settings)
    fusion = settings.get("fusion", {})
    if fusion.get("weights") and fusion["c"] != "zscore":
        raise SettingsError(f"fusion.weights={fusion['weights']}: expected fusion.c=zscore as well")
    if settings.get("threshold") is not None and settings["confidence"] is None:
        raise SettingsError(f"threshold={settings['threshold']}: expected confidence=FILE as well, the confidence.json "
                            "of a run on other images with ground truth")  # fmt: skip


def _rule(path: str, methods: Mapping[str, str]) -> Rule | None:
    """Of a setting, given the method of each system's scorer; None for a group of settings."""
    if path.startswith("fusion.weights."):  # names are checked where the scorers are
        return _POSITIVE
    *_, group, name = f".{path}".split(".")
    scorers, method = scorer_rules(CONF / "rules.yaml"), methods["scorer"]
    own = scorers.get(group if group in scorers else methods.get(group, ""), {})
    if path.startswith("scorer."):
        return own.get(name) or (_one_of(*scorers) if path == "scorer.method" else None)
    if group == "grid":
        known = (rules[name] for rules in (scorers.get(method, {}), *scorers.values(), RULES) if name in rules)
        return next(map(_axis, known), None)
    return RULES.get(f"{group}.{name}") or RULES.get(name)


@cache
def scorer_rules(file: Path) -> dict[str, dict[str, Rule]]:
    """Rules by scorer and parameter, of what `experiments.declare` wrote."""
    import yaml  # here, since Ctrl-C is not yet answered above

    found = {}
    for scorer, limits in yaml.safe_load(file.read_text(encoding="utf-8")).items():
        method = Rule(_one_of(scorer).holds, f"{scorer}; choose with scorer={scorer}")
        found[scorer] = {"method": method} | {name: _within(**one) for name, one in limits.items()}
    return found


def _within(*, length: int = 0, optional: bool = False, **limits: list[Any]) -> Rule:
    """The rule of `mfvpr.declaration.Parameter.limits`."""
    [(kind, values)] = limits.items()
    rule = {"choices": _one_of, "whole": _between, "number": _number}[kind](*values)
    rule = _list_of(rule, max(length, 0)) if length else rule
    return _or(rule, None) if optional else rule


def _check_vocabulary(settings: Mapping[str, Any]) -> None:
    words, samples = (settings.get(name, 1) for name in ("num_words", "max_samples"))
    if samples < words:
        raise SettingsError(f"retrieval.max_samples={samples}: expected at least retrieval.num_words={words}")


def _check_cells(settings: Mapping[str, Any]) -> None:
    """That features are cells of a grid, and as many as the score of such cells expects."""
    features, side = settings["features"], settings["scorer"]["side"]
    if features["name"] not in ("ssm", "import"):
        raise SettingsError(f"scorer=grid: expected features=ssm, whose features are cells, got {features['name']}")
    matching = settings["matching"]
    if (check := matching.get("cross_check", matching["name"])) != "candidate":
        raise SettingsError(f"matching.cross_check={check}: expected candidate, since scorer=grid takes a match of "
                            "every cell of the candidate")  # fmt: skip
    if features["name"] == "ssm":
        sides = [(-(-pixels // 8) - 3) // features["stride"] + 1 for pixels in features["image_size"]]
        if sides != [side, side]:
            raise SettingsError(f"scorer.side={side}: expected the cells of features.image_size="
                                f"{features['image_size']}, which are {sides[0]} x {sides[1]}")  # fmt: skip


def _shown(value: Any) -> str:
    text = "null" if value is None else str(value)
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN // 2]}..."


def _leaves(settings: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
