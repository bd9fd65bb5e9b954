"""Check every setting before any work, and before anything slow is imported.

Hydra checks which settings exist; the values are checked here.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

_INSTALLED = Path(__file__).parent / "conf"  # in a wheel; in a clone, it stands beside the package
CONF = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[2] / "conf"


class SettingsError(Exception):
    """One line for a setting that cannot be used: its name, the expected value, and its value."""


class Rule(NamedTuple):
    """A test of a setting's value, and what it expects in words."""

    holds: Callable[[Any], bool]
    expected: str


def pattern(regex: str, expected: str) -> Rule:
    """Text that matches a regular expression."""
    return Rule(lambda value: isinstance(value, str) and bool(re.fullmatch(regex, value)), expected)


def one_of(*choices: Any) -> Rule:
    """One of some words, numbers, flags or null."""
    words = ("null" if choice is None else str(choice).lower() if isinstance(choice, bool) else str(choice)
             for choice in choices)  # fmt: skip
    return Rule(
        lambda value: any(type(value) is type(choice) and value == choice for choice in choices),
        "one of " + ", ".join(words),
    )


def number(low: float, high: float) -> Rule:
    """A number in a range, its ends included."""
    return Rule(
        lambda value: type(value) in (int, float) and low <= value <= high,
        f"a number from {low:g} to {high:g}",
    )


def whole(low: int, high: int) -> Rule:
    """An integer in a range, its ends included."""
    return Rule(
        lambda value: type(value) is int and low <= value <= high,
        f"a whole number from {low} to {high}",
    )


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of a given length, or of any above 0."""

    def holds(value: Any) -> bool:
        has_length = isinstance(value, list) and (len(value) == length if length else bool(value))
        return has_length and all(map(rule.holds, value))

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def any_of(expected: str, *rules: Rule) -> Rule:
    """A value that one of several rules allows."""
    return Rule(lambda value: any(rule.holds(value) for rule in rules), expected)


def either(rule: Rule, *choices: Any) -> Rule:
    """A value that a rule allows, or one of some choices."""
    other = one_of(*choices)
    return any_of(f"{rule.expected}, or {other.expected.removeprefix('one of ')}", rule, other)


def or_list(rule: Rule) -> Rule:
    """A value that a rule allows, or a list of such values."""
    return any_of(f"{rule.expected}, or a list of them", rule, list_of(rule))


_MAX_SHOWN = 200  # characters of a value in an error
# Beyond these bounds float32 and int32 would fail silently.
_POSITIVE = number(1e-6, 1e12)
_NOT_NEGATIVE = number(0, 1e12)
_COUNT = whole(1, 10**6)
_INDEX = whole(0, 10**6)
_SIDE_MOST, _LEAST_PIXELS = 4096, 10_000  # fewer pixels are a side that was meant
_SIDE = whole(16, _SIDE_MOST)
_ANY_SHAPE = ("sift", "aliked", "d2net")  # features of images of any shape
_TEXT = pattern(r"(?s).+", "text")
_PATH = pattern(r"(?s)(?!.*\$\{).+", "a path, with names of variables filled in (double quotes let the shell do that)")
_QUERY = any_of("a row or a name of a query", _INDEX, _TEXT)
_FIGURES = any_of("how many (at most 1000000), or a list of rows or names of queries", _INDEX, list_of(_QUERY))

# Rules by names of settings: `.name` is outside of groups, `group.name` in one group.
RULES: dict[str, Rule] = {
    name: rule
    for names, rule in {
        # choices
        "widen_index orient multiscale zero_row watch add verified confidences .compiled": one_of(True, False),
        "features.name": one_of("sift", "d2net", "aliked", "ssm", "patch_netvlad", "selavpr", "dinov2", "import"),
        "retrieval.name": one_of("vlad", "mixvpr", "netvlad", "gem", "dinov2", "ssm", "same", "import", "pairs"),
        "matching.name": one_of("neighbors", "lightglue", "import"),
        "cluster.name": one_of("local", "slurm", "address"),
        "ground_truth": one_of(None, "order", "index", "utm", "label", "none"),  # None: an error, see build.dataset
        "lengths": one_of("unit", "normalize", "keep"),
        "seasons": list_of(one_of("fall", "spring", "summer", "winter"), 2),
        "interpolation": one_of(
            "pil_bilinear", "pil_bicubic", "cv2_linear", "cv2_area", "cv2_cubic", "torch_bilinear", "torch_no_antialias"
        ),
        "preprocessing": one_of("caffe", "torch"),
        "pooling": one_of("cls", "gem"),
        "facet": one_of("token", "query", "key", "value"),
        "cross_check": one_of("mutual", "opencv_legacy", "none", "candidate"),
        "retrieval_score": one_of("cosine", "negative_euclidean"),
        "ties": one_of("retrieval", "index"),
        "final": one_of("score", "combined"),
        "on_bad_image": one_of("fail", "skip"),
        "search": one_of("grid", "optuna"),
        "split": one_of(None, "first_half", "second_half", "both"),
        "loss": one_of("cross_entropy", "recall", "average_precision"),
        "inputs": one_of("relative", "absolute"),
        # paths and text
        "root cache database .map": _PATH,
        "queries matching.matches .images": or_list(_PATH),
        "index_file database_labels query_labels .cache out checkpoints .confidence .data .root": either(_PATH, None),
        "matching.features query_features": either(_PATH, None),
        "dataset.name": pattern(r"[\w-][\w.-]*", "letters, digits, - and _"),
        "weights": _TEXT,
        "database_prefix query_prefix": either(_TEXT, ""),
        "also report": either(_TEXT, None),
        ".datasets .systems": either(list_of(_TEXT), None),
        "cluster.address": pattern(r"(tcp|tls|ucx)://\S+:\d+", "tcp://HOST:PORT"),
        "cluster.options": either(_TEXT, ""),
        "shard": either(pattern(r"[0-9]+/[0-9]+", "i/n with i from 0 to n - 1, such as 0/8"), None),
        "figures": _FIGURES,
        # whole numbers
        "seed alternatives recent": _INDEX,
        "exclude_neighbors cohort": either(_INDEX, None),
        "tolerances": list_of(_INDEX),
        "max_samples steps every patience workers": _COUNT,
        "max_images max_windows max_matches chunk_size chunk.settings chunk.queries": either(_COUNT, None),
        "candidates devices": either(_COUNT, "all"),
        "ks": list_of(_COUNT),
        "image_size": list_of(_SIDE, 2),
        "matching.image_size": either(list_of(_SIDE, 2), None),
        "features.image_size": any_of(
            "[width, height], each a whole number from 16 to 4096, or auto, a number of pixels from 10000, or null",
            list_of(_SIDE, 2),
            whole(_LEAST_PIXELS, _SIDE_MOST**2),
            one_of("auto", None),
        ),
        "bits": either(whole(8, 16), None),
        "max_keypoints": either(whole(1, 20_000), None),
        "batch_size": whole(1, 256),
        "num_words dimension": whole(1, 4096),
        "whiten components": either(whole(1, 4096), None),
        "patch_sizes": list_of(whole(1, 64)),
        "stride": whole(1, 8),
        "block": whole(-24, 23),
        "previous_queries": whole(0, 1000),
        ".sequence": either(or_list(one_of("causal", "lagged", "smoothed")), None),
        "trials": whole(1, 100_000),
        "batch hidden": whole(1, 1024),
        # numbers
        "contrast_threshold power radius learning_rate": _POSITIVE,
        "scale_weights": either(list_of(_POSITIVE), None),
        "memory": either(_POSITIVE, None),
        "threshold clahe_clip": _NOT_NEGATIVE,
        "max_distance": either(number(1e-6, 2), None),
        "filter_threshold": number(0, 1),
        "depth_confidence .threshold": either(number(0, 1), None),
        "c": either(_NOT_NEGATIVE, "auto"),
        "fusion.c": either(_NOT_NEGATIVE, "auto", "zscore"),
        "fusion.weights": any_of("weights by name, such as {retrieval: 0.5, anchor: 1}, or null", one_of(None)),
        "field_of_view": either(number(5, 179), None),
        "route": either(number(-1000, 1000), None, "auto"),
    }.items()
    for name in names.split()
}
# Settings of a histogram that were removed in version 0.3.0, and the values with which they changed nothing.
REMOVED = {"scales": [1.0], "scale_deviation": None}
# Settings that take effect with another one only, and the words of the error.
_NEEDS = (
    ("also", "report", "report=DATASET,... as well, to learn on several data sets and report on others"),
    ("cluster", "cache", "cache=DIR as well, a folder that all workers share"),
    ("shard", "cache", "cache=DIR as well, the same of all shards"),
    ("threshold", "confidence", "confidence=FILE as well, the confidence.json of a run on other images with ground "
     "truth"),
)  # fmt: skip


def check(settings: Mapping[str, Any]) -> None:
    """Raise a SettingsError for the first value that its rule, or another setting, does not allow."""
    scorer, retrieval, features, fusion = (
        settings.get(group, {}) for group in ("scorer", "retrieval", "features", "fusion")
    )
    scorers = {name: values for name, values in scorer.items() if isinstance(values, Mapping)}
    method = str(scorer.get("method") or "")  # "" if there are several
    _check_values(settings, {name: str(values.get("method")) for name, values in scorers.items()} | {"scorer": method})
    words, samples = (retrieval.get(name, 1) for name in ("num_words", "max_samples"))
    if samples < words:
        raise SettingsError(f"retrieval.max_samples={samples}: expected at least retrieval.num_words={words}")
    if features.get("name", "import") != "import" and features["image_size"] is None:
        raise SettingsError(f"features.image_size=null: expected width and height for features={features['name']}, "
                            "such as [336,336]")  # fmt: skip
    if not isinstance(size := features.get("image_size"), list | None) and features["name"] not in _ANY_SHAPE:
        raise SettingsError(f"features.image_size={size}: expected [width, height] for features={features['name']}; "
                            f"other values are for {', '.join(_ANY_SHAPE)}")  # fmt: skip
    if method == "grid":
        _check_cells(settings)
    if features.get("name") == "patch_netvlad":
        for path, values in [("scorer", scorer), *((f"scorer.{name}", values) for name, values in scorers.items())]:
            if values.get("size") is not None:
                _check_patches(features, f"{path}.size", values["size"])
    if settings.get("report"):
        _check_report(settings)
    if settings.get("images") and settings["figures"] and settings["out"] is None:
        raise SettingsError(f"figures={settings['figures']}: expected out=DIR as well, where they are drawn")
    if fusion.get("weights") and fusion["c"] != "zscore":
        raise SettingsError(f"fusion.weights={fusion['weights']}: expected fusion.c=zscore as well, or "
                            "fusion.weights=null")  # fmt: skip
    for name, needed, expected in _NEEDS:
        if name == "threshold" and "images" in settings:  # a map may have a confidence of its own
            continue
        if (value := settings.get(name)) is not None and settings[needed] is None:
            value = value["name"] if isinstance(value, Mapping) else value
            raise SettingsError(f"{name}={value}: expected {expected}")


def without_removed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of an old file without `REMOVED` ones that changed nothing."""
    return {
        name: without_removed(value) if isinstance(value, Mapping) else value
        for name, value in settings.items()
        if name not in REMOVED or value != REMOVED[name]
    }


def _check_values(settings: Mapping[str, Any], methods: Mapping[str, str]) -> None:
    for path, value in nodes(settings):
        if isinstance(value, Mapping):
            continue
        rule = _rule(path, methods)
        if rule is None and path.rpartition(".")[2] in REMOVED:
            raise SettingsError(f"{path}={value}: this setting was removed in version 0.3.0")
        if rule is None and methods["scorer"] and path.startswith("scorer."):
            name = path.removeprefix("scorer.")
            raise SettingsError(f"scorer={methods['scorer']} has no setting {name}; see --help")
        if rule is None:
            raise SettingsError(f"{path}={value}: this is a group of settings; set one of its members (see --help)")
        if not rule.holds(value):
            text = "null" if value is None else str(value)
            text = text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN // 2]}..."
            raise SettingsError(f"{path}={text}: expected {rule.expected}")


def _check_report(settings: Mapping[str, Any]) -> None:
    for group in ("features", "retrieval", "matching"):
        if (name := settings[group]["name"]) in ("import", "pairs"):
            raise SettingsError(f"{group}={name}: expected none with report=, since the files are of one data set")
    if settings["split"] != "both":
        raise SettingsError(f"split={settings['split']}: expected none with report=, since the data sets are the split")


def _rule(path: str, methods: Mapping[str, str]) -> Rule | None:
    """The rule of a setting, given the method of each system's scorer; None for a group of settings."""
    if path.startswith("fusion.weights."):  # names are checked where the scorers are
        return _POSITIVE
    *_, group, name = f".{path}".split(".")
    scorers = scorer_rules(CONF / "rules.yaml")
    if path.startswith("scorer."):
        rules = scorers.get(group if group in scorers else methods.get(group, ""), {})
        rule = rules.get(name) or (one_of(*scorers) if path == "scorer.method" else None)
        return or_list(rule) if rule and name == "weight" else rule
    if group == "grid":
        owners = (scorers.get(methods["scorer"], {}), *scorers.values(), RULES)
        listed = next((list_of(rules[name]) for rules in owners if name in rules), None)
        return listed and any_of(f"{listed.expected}; null is the scorer's own value", one_of(None), listed)
    return RULES.get(f"{group}.{name}") or RULES.get(name)


@cache
def scorer_rules(file: Path) -> dict[str, dict[str, Rule]]:
    """Rules by scorer and parameter, from the file that `mfvpr.cli.declare` wrote."""
    import yaml  # here, since Ctrl-C is not yet handled above

    rules = {}
    for scorer, limits in yaml.safe_load(file.read_text(encoding="utf-8")).items():
        method = Rule(one_of(scorer).holds, f"{scorer}; choose with scorer={scorer}")
        rules[scorer] = {"method": method} | {name: _limit_rule(**limit) for name, limit in limits.items()}
    return rules


def _limit_rule(*, length: int = 0, optional: bool = False, file: str = "", **limits: list[Any]) -> Rule:
    """The rule of `mfvpr.core.parameters.Parameter.limits`."""
    [(kind, values)] = limits.items()
    rule = {"choices": one_of, "whole": whole, "number": number}[kind](*values)
    if file:
        files = pattern(f"(?s).*{re.escape(file)}", f"a file that ends in {file}")
        rule = any_of(f"{rule.expected}, or {files.expected}", rule, files)
    rule = list_of(rule, length) if length else rule
    return either(rule, None) if optional else rule


def _check_cells(settings: Mapping[str, Any]) -> None:
    """Check that features are the cells of a square grid, as scorer=grid expects."""
    features, side = settings["features"], settings["scorer"]["side"]
    if features["name"] not in ("ssm", "import") and settings["matching"]["name"] != "import":
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


def _check_patches(features: Mapping[str, Any], path: str, reach: list[float]) -> None:
    """Check the rapid score's size, which the configurations give for their own image size and patch sizes."""
    expected = [[16 * (pixels // 16 - patch) for pixels in features["image_size"]] for patch in features["patch_sizes"]]
    if min(map(min, expected)) < 0:
        return  # the images are too small for these patches, which is the extractor's error
    if expected != [list(reach)]:
        words = "null, since each size of patches has its own"
        if len(expected) == 1:
            words = f"{expected[0]}, the largest place of these patches, or null"
        raise SettingsError(f"{path}={reach}: expected {words}")


def nodes(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All settings and groups of settings, by dotted name."""
    for name, value in settings.items():
        yield f"{prefix}{name}", value
        if isinstance(value, Mapping):
            yield from nodes(value, f"{prefix}{name}.")
