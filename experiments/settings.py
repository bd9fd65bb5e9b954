"""Check every setting before any work, and before anything slow is imported.

Hydra checks which settings exist; the values are checked here.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from experiments.rules import Rule, axis, between, either, is_count, list_of, number, one_of, or_file, or_list, pattern

CONF = Path(__file__).parent.parent / "conf"

Program = Callable[[], Callable[[dict[str, Any]], None]]  # imports the job, which is slow, and returns it


class SettingsError(Exception):
    """One line for a setting that cannot be used: its name, the expected value, and its value."""


_MAX_SHOWN = 200  # characters of a value in an error
# Beyond these bounds float32 and int32 would fail silently.
_POSITIVE = number(1e-6, 1e12)
_NOT_NEGATIVE = number(0, 1e12)
_COUNT = Rule(lambda value: is_count(value) and 0 < value <= 10**6, "a whole number above 0 (at most 1000000)")
_INDEX = Rule(lambda value: is_count(value) and 0 <= value <= 10**6, "a whole number not below 0 (at most 1000000)")
_SIDE = between(16, 4096)
_DISTANCE = number(1e-6, 2)
_TEXT = pattern(r"(?s).+", "text")
_PATH = Rule(
    lambda value: isinstance(value, str) and bool(value) and "${" not in value,
    "a path, with names of variables filled in (double quotes let the shell do that)",
)
_QUERY = Rule(lambda value: _INDEX.holds(value) or _TEXT.holds(value), "a row or a name of a query")
_FIGURES = Rule(
    lambda value: _INDEX.holds(value) or list_of(_QUERY).holds(value),
    "how many (at most 1000000), or a list of rows or names of queries",
)
_ADDRESS = pattern(r"[^\s:]+:[0-9]{1,5}", "HOST:PORT of the first task, such as node1:7654")
_FLAG = one_of(True, False)

RULES: dict[str, Rule] = {
    "dataset.name": pattern(r"[\w-][\w.-]*", "letters, digits, - and _"),
    "features.name": one_of("sift", "d2net", "aliked", "ssm", "patch_netvlad", "selavpr", "import"),
    "retrieval.name": one_of("vlad", "mixvpr", "netvlad", "gem", "dinov2", "ssm", "same", "import", "pairs"),
    "features.image_size": either(list_of(_SIDE, 2), None),
    # data
    "seed": _INDEX,
    "cache": _PATH,
    "root": _PATH,
    "database": _PATH,
    "queries": or_list(_PATH),
    "ground_truth": one_of(None, "order", "index", "utm", "label", "none"),  # None: an error, see build.dataset
    "index_file": either(_PATH, None),
    "widen_index": _FLAG,
    "lengths": one_of("unit", "normalize", "keep"),
    "database_prefix": either(_TEXT, ""),
    "query_prefix": either(_TEXT, ""),
    "database_labels": either(_PATH, None),
    "query_labels": either(_PATH, None),
    "exclude_neighbors": either(_INDEX, None),
    "seasons": list_of(one_of("fall", "spring", "summer", "winter"), 2),
    "orient": _FLAG,
    "bits": either(between(8, 16), None),
    # features and retrieval
    "image_size": list_of(_SIDE, 2),
    "interpolation": one_of(
        "pil_bilinear", "pil_bicubic", "cv2_linear", "cv2_area", "cv2_cubic", "torch_bilinear", "torch_no_antialias"
    ),
    "weights": _TEXT,
    "preprocessing": one_of("caffe", "torch"),
    "multiscale": _FLAG,
    "threshold": _NOT_NEGATIVE,
    "max_keypoints": either(between(1, 20_000), None),
    "batch_size": between(1, 256),
    "contrast_threshold": _POSITIVE,
    "clahe_clip": _NOT_NEGATIVE,
    "num_words": between(1, 4096),
    "power": _POSITIVE,
    "max_samples": _COUNT,
    "whiten": either(between(1, 4096), None),
    "dimension": between(1, 4096),
    "components": either(between(1, 4096), None),
    "max_images": either(_COUNT, None),
    "max_windows": either(_COUNT, None),
    "zero_row": _FLAG,
    "patch_sizes": list_of(between(1, 64)),
    "scale_weights": either(list_of(_POSITIVE), None),
    "pooling": one_of("cls", "gem"),
    "stride": between(1, 8),
    "candidates": either(_COUNT, "all"),
    "memory": either(_POSITIVE, None),
    "devices": either(_COUNT, "all"),
    # matching
    "matching.name": one_of("neighbors", "lightglue"),
    "filter_threshold": number(0, 1),
    "depth_confidence": either(number(0, 1), None),
    "cross_check": one_of("mutual", "opencv_legacy", "none", "candidate"),
    "max_distance": either(_DISTANCE, None),
    "max_matches": either(_COUNT, None),
    "chunk_size": either(_COUNT, None),
    # scores, besides those of each scorer
    "filter_score": one_of("cosine", "negative_euclidean"),
    "ties": one_of("filter", "index"),
    "c": either(_NOT_NEGATIVE, "auto"),
    "fusion.c": either(_NOT_NEGATIVE, "auto", "zscore"),
    "fusion.weights": Rule(lambda value: value is None, "weights by name, such as {filter: 0.5, anchor: 1}, or null"),
    "final": one_of("score", "combined"),
    "previous_queries": between(0, 1000),
    "cohort": either(_INDEX, None),
    ".confidence": either(_PATH, None),
    ".threshold": either(number(0, 1), None),
    # the paper's evaluation
    ".data": either(_PATH, None),
    ".datasets": either(list_of(_TEXT), None),
    ".systems": either(list_of(_TEXT), None),
    # localization in a map
    ".map": _PATH,
    ".images": or_list(_PATH),
    "watch": _FLAG,
    "alternatives": _INDEX,
    "recent": _INDEX,
    "route": either(number(-1000, 1000), None),
    "add": _FLAG,
    ".root": either(_PATH, None),
    # report
    "tolerances": list_of(_INDEX),
    "radius": _POSITIVE,
    "ks": list_of(_COUNT),
    "store": either(_PATH, None),
    "on_bad_image": one_of("fail", "skip"),
    "figures": _FIGURES,
    "out": either(_PATH, None),
    "shard": either(pattern(r"[0-9]+/[0-9]+", "i/n with i from 0 to n - 1, such as 0/8"), None),
    "wait": number(0, 1e9),
    "coordinator": either(_ADDRESS, None),
    # sweeps
    "search": one_of("grid", "optuna"),
    "trials": between(1, 100_000),
    "split": one_of(None, "first_half", "second_half", "both"),
    # learning
    "loss": one_of("cross_entropy", "recall", "average_precision"),
    "steps": _COUNT,
    "every": _COUNT,
    "patience": _COUNT,
    "batch": between(1, 1024),
    "learning_rate": _POSITIVE,
    "hidden": between(1, 1024),
    "inputs": one_of("relative", "absolute"),
    "also": either(_TEXT, None),
    "report": either(_TEXT, None),
    "checkpoints": either(_PATH, None),
    "chunk.settings": either(_COUNT, None),
    "chunk.queries": either(_COUNT, None),
}


def check(settings: Mapping[str, Any]) -> None:
    """Raise a SettingsError for the first value that its rule, or another setting, does not allow."""
    scorer = settings.get("scorer", {})
    scorers = {name: values for name, values in scorer.items() if isinstance(values, Mapping)}
    method = str(scorer.get("method") or "")  # "" if there are several
    _check_values(settings, {name: str(values.get("method")) for name, values in scorers.items()} | {"scorer": method})
    retrieval, features = (settings.get(group, {}) for group in ("retrieval", "features"))
    words, samples = (retrieval.get(name, 1) for name in ("num_words", "max_samples"))
    if samples < words:
        raise SettingsError(f"retrieval.max_samples={samples}: expected at least retrieval.num_words={words}")
    if features.get("name") in ("sift", "ssm", "patch_netvlad", "selavpr") and features["image_size"] is None:
        raise SettingsError(f"features.image_size=null: expected width and height for features={features['name']}, "
                            "such as [336,336]")  # fmt: skip
    if method == "grid":
        _check_cells(settings)
    if features.get("name") == "patch_netvlad":
        for path, values in [("scorer", scorer), *((f"scorer.{name}", values) for name, values in scorers.items())]:
            if values.get("size") is not None:
                _check_patches(features, f"{path}.size", values["size"])
    _check_report(settings)
    if settings.get("images") and settings["figures"] and settings["out"] is None:
        raise SettingsError(f"figures={settings['figures']}: expected out=DIR as well, where they are drawn")
    fusion = settings.get("fusion", {})
    if fusion.get("weights") and fusion["c"] != "zscore":
        raise SettingsError(f"fusion.weights={fusion['weights']}: expected fusion.c=zscore as well, or "
                            "fusion.weights=null")  # fmt: skip
    _check_shard(settings)
    if settings.get("threshold") is not None and settings["confidence"] is None:
        raise SettingsError(f"threshold={settings['threshold']}: expected confidence=FILE as well, the confidence.json "
                            "of a run on other images with ground truth")  # fmt: skip


def _check_values(settings: Mapping[str, Any], methods: Mapping[str, str]) -> None:
    for path, value in _leaves(settings, ""):
        rule = _rule(path, methods)
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
    if settings.get("also") and not settings["report"]:
        raise SettingsError(f"also={settings['also']}: expected report=DATASET,... as well, to learn on several data "
                            "sets and report on others")  # fmt: skip
    if not settings.get("report"):
        return
    for group in ("features", "retrieval"):
        if (name := settings[group]["name"]) in ("import", "pairs"):
            raise SettingsError(f"{group}={name}: expected none with report=, since the files are of one data set")
    if settings["split"] != "both":
        raise SettingsError(f"split={settings['split']}: expected none with report=, since the data sets are the split")


def _check_shard(settings: Mapping[str, Any]) -> None:
    for name in ("coordinator", "wait"):
        if settings.get(name) and settings["shard"] is None:
            raise SettingsError(f"{name}={settings[name]}: expected shard=i/n as well, this task's part")
    if settings.get("shard") is not None:
        for name in ("out", "store"):
            if settings[name] is None:
                raise SettingsError(f"shard={settings['shard']}: expected {name}=DIR as well, the same of all shards")


def _rule(path: str, methods: Mapping[str, str]) -> Rule | None:
    """The rule of a setting, given the method of each system's scorer; None for a group of settings."""
    if path.startswith("fusion.weights."):  # names are checked where the scorers are
        return _POSITIVE
    *_, group, name = f".{path}".split(".")
    scorers = scorer_rules(CONF / "rules.yaml")
    if path.startswith("scorer."):
        rules = scorers.get(group if group in scorers else methods.get(group, ""), {})
        return rules.get(name) or (one_of(*scorers) if path == "scorer.method" else None)
    if group == "grid":
        owners = (scorers.get(methods["scorer"], {}), *scorers.values(), RULES)
        return next((axis(rules[name]) for rules in owners if name in rules), None)
    return RULES.get(f"{group}.{name}") or RULES.get(name)


@cache
def scorer_rules(file: Path) -> dict[str, dict[str, Rule]]:
    """Rules by scorer and parameter, from the file that `experiments.declare` wrote."""
    import yaml  # here, since Ctrl-C is not yet handled above

    rules = {}
    for scorer, limits in yaml.safe_load(file.read_text(encoding="utf-8")).items():
        method = Rule(one_of(scorer).holds, f"{scorer}; choose with scorer={scorer}")
        rules[scorer] = {"method": method} | {name: _within(**limit) for name, limit in limits.items()}
    return rules


def _within(*, length: int = 0, optional: bool = False, file: str = "", **limits: list[Any]) -> Rule:
    """The rule of `mfvpr.scoring.fields.Parameter.limits`."""
    [(kind, values)] = limits.items()
    rule = {"choices": one_of, "whole": between, "number": number}[kind](*values)
    rule = or_file(rule, file) if file else rule
    rule = list_of(rule, max(length, 0)) if length else rule
    return either(rule, None) if optional else rule


def _check_cells(settings: Mapping[str, Any]) -> None:
    """Check that features are the cells of a square grid, as scorer=grid expects."""
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


def _check_patches(features: Mapping[str, Any], path: str, reach: list[float]) -> None:
    """Check the rapid score's size, which the configurations give for their own image size and patch sizes."""
    expected = [[16 * (pixels // 16 - patch) for pixels in features["image_size"]] for patch in features["patch_sizes"]]
    if min(map(min, expected)) < 0:
        return  # the images are too small for these patches, which is the extractor's error
    if expected != [list(reach)]:
        of_patches = f"{expected[0]}, the largest place of these patches, or" if len(expected) == 1 else "null, since"
        why = "null" if len(expected) == 1 else "each size of patches has its own"
        raise SettingsError(f"{path}={reach}: expected {of_patches} {why}")


def _leaves(settings: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
