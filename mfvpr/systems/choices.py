"""The choices of each group of settings: which settings a choice has, from the fields of the classes that it makes.

A choice that is named in a file is looked up here; nothing else can be made.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from mfvpr import features
from mfvpr.baselines.learned_weight import NAMED_WEIGHTS, SUFFIX
from mfvpr.baselines.scorers import SCORERS
from mfvpr.evaluation.rankings import RetrievalScore, Ties
from mfvpr.features.windows import WindowFitting
from mfvpr.io.checks import Lengths
from mfvpr.matchers import LightGlueMatcher, NearestNeighborMatcher
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import (
    COUNT,
    FLAG,
    NOT_NEGATIVE,
    PATH,
    POSITIVE,
    REQUIRED,
    SIZE,
    TEXT,
    Rule,
    Setting,
    check_fields,
    check_values,
    group,
    list_of,
    one_of,
    or_list,
    setting,
    settings_of,
    text,
    whole,
    word_of,
)

_INSTALLED = Path(__file__).parent / "conf"  # in a wheel; in a clone, it stands beside the package
CONF = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[2] / "conf"
GROUPS = ("features", "retrieval", "matching", "scorer")

_WHITEN = Setting(
    None,
    whole(1, 4096) | None,
    "principal components that are kept, each of unit variance, fitted on the database; null = as they are",
)
_SHAPED = SIZE | whole(10_000, 4096**2) | "auto"  # a number of pixels; fewer than 10,000 are a side that was meant


@dataclass(frozen=True)
class _Files:
    """Settings of files of another program."""

    database: str = setting(REQUIRED, PATH, "file or folder")
    queries: str = setting(REQUIRED, or_list(PATH), "likewise; [FILE,FILE,...] of several sequences")
    database_prefix: str = setting("", TEXT | "", "what stands before the images' names in the file, such as database/")
    query_prefix: str = setting("", TEXT | "")
    lengths: Lengths = setting("unit", word_of(Lengths), "of descriptors")
    image_size: list[int] | None = setting(None, SIZE | None, "width, height, where the files do not tell")


@dataclass(frozen=True)
class _Matches:
    """Settings of matches of another program."""

    matches: str = setting(REQUIRED, or_list(PATH), "file or folder; [FILE,FILE,...] of several sequences")
    features: str | None = setting(None, PATH | None, "hloc's feats*.h5 that were matched")
    query_features: str | None = setting(None, PATH | None, "those of the queries, if they are in another file")
    database_prefix: str = setting("", TEXT | "", "what stands before the images' names in the files")
    query_prefix: str = setting("", TEXT | "")
    lengths: Lengths = setting("unit", word_of(Lengths), "of the features' descriptors")
    image_size: list[int] | None = setting(None, SIZE | None, "width, height of the images that the points are in")
    verified: bool = setting(False, FLAG, "true: matches that fit a geometric model, of COLMAP or vismatch")
    confidences: bool = setting(True, FLAG, "false: all matches count alike")


def without(settings: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The settings but for those of some names."""
    return {name: value for name, value in settings.items() if name not in names}


def _network(weights: str, owner: type, **more: Any) -> dict[str, Any]:
    """Settings of a network: of its weights, of its extractor, and further ones."""
    note = "`mfvpr weights list` has all weights"
    return {"weights": Setting(weights, TEXT, note), **without(settings_of(owner), "whitening"), **more}


def _features() -> dict[str, dict[str, Any]]:
    files = settings_of(_Files)
    known = {
        "sift": settings_of(features.Sift),
        "aliked": _network("aliked-n16", features.AlikedFeatures),
        "d2net": _network("d2_tf", features.D2NetFeatures),
        "ssm": _network("vgg16_places365", features.SsmCells, **settings_of(WindowFitting)),
        "patch_netvlad": _network("patchnetvlad_mapillary_512", features.PatchNetVladFeatures),
        "selavpr": _network("selavpr_msls", features.SelaVprFeatures),
        "dinov2": _network("dinov2_vitl14", features.Dinov2Features),
        "import": files,
    }
    for name in ("sift", "aliked", "d2net"):  # of images of any shape
        known[name]["image_size"] = replace(known[name]["image_size"], rule=_SHAPED)
    del known["sift"]["batch_size"]
    return known


def _retrieval() -> dict[str, dict[str, Any]]:
    files, whiten = settings_of(_Files), {"whiten": _WHITEN}
    descriptor = features.GlobalDescriptor
    fitting: dict[str, Any] = settings_of(WindowFitting)
    fitting["dimension"] = replace(fitting["dimension"], default=125)
    pooling = {
        "pooling": Setting("cls", one_of("cls", "gem"), "the class token, or the generalized mean of the patches'"),
        "power": Setting(3.0, POSITIVE, "of the generalized mean: from the mean, 1, towards the maximum"),
    }
    small = {"image_size": Setting([224, 224], SIZE, "width, height, multiples of 14")}
    mixvpr = {"image_size": Setting([320, 320], SIZE, "width, height: the only one that its weights are for")}
    windows = {"image_size": Setting([224, 224], SIZE, "width, height: the only one that it takes")}
    without_components = without(_network("", descriptor), "components", "weights")
    return {
        "vlad": {**settings_of(features.VladFitting), **whiten},
        "mixvpr": _network("mixvpr_4096", features.MixVprDescriptor, **mixvpr, **whiten),
        "netvlad": _network("netvlad_pitts30k", descriptor, **whiten),
        "gem": {**_weights("cosplace_resnet50_2048"), **without_components, **whiten},
        "dinov2": {**_weights("dinov2_vitl14"), **without_components, **small, **pooling, **whiten},
        "ssm": _network("vgg16_places365", features.SsmWindows, **windows, **fitting),
        "same": whiten,
        "import": {**without(files, "image_size"), **whiten},
        "pairs": without(files, "database", "lengths", "image_size"),
    }


def _weights(name: str) -> dict[str, Setting]:
    return {"weights": Setting(name, TEXT, "`mfvpr weights list` has all weights")}


def _matching() -> dict[str, dict[str, Any]]:
    return {
        "neighbors": settings_of(NearestNeighborMatcher),
        "lightglue": {**_weights("aliked_lightglue"), **settings_of(LightGlueMatcher)},
        "import": settings_of(_Matches),
    }


def _scorer(scorer: type) -> dict[str, Setting]:
    """Settings of a scorer from its fields; a match weight may also be one that is named, or a file."""
    known = settings_of(scorer)
    if "weight" in known:
        files = text(f"(?s).*{SUFFIX}", f"a file that ends in {SUFFIX}")
        rule, note = one_of(*NAMED_WEIGHTS) | files, "a list: a scorer of each"
        known["weight"] = replace(known["weight"], rule=rule, note=note)
    return known


@cache
def choices_of(group: str) -> dict[str, dict[str, Any]]:
    """Settings of a group by choice and name. `name` in a group's settings, or `method` of a scorer, is the choice."""
    if group == "scorer":
        return {name: _scorer(scorer) for name, scorer in SCORERS.items()}
    return {"features": _features, "retrieval": _retrieval, "matching": _matching}[group]()


def check_group(group: str, values: Any) -> None:
    """Raise an InputError for a value of a choice that is not allowed, or a setting that the choice does not have."""
    if group == "scorer" and isinstance(values, Mapping) and "method" not in values:
        for name, each in values.items():
            _check_choice("scorer", f"scorer.{name}", each, "method")
    else:
        _check_choice(group, group, values, "method" if group == "scorer" else "name")


def _check_choice(group: str, prefix: str, values: Any, key: str) -> None:
    choices = choices_of(group)
    choice = values.get(key) if isinstance(values, Mapping) else values
    if not isinstance(values, Mapping) or choice not in choices:
        raise InputError(f"{prefix}.{key}={choice}: expected one of {', '.join(choices)}")
    known = choices[choice]
    if group == "scorer" and isinstance(values.get("weight"), list) and "weight" in known:
        known = {**known, "weight": replace(known["weight"], rule=list_of(known["weight"].rule))}
    check_values(known, without(values, key), f"{prefix}.")


def _is_weights(value: Any) -> bool:
    return value is None or (isinstance(value, Mapping) and all(map(POSITIVE.holds, value.values())))


@dataclass(frozen=True)
class FusionSettings:
    """Fusion of scores with that of the retrieval."""

    c: float | str = setting(
        "auto",
        NOT_NEGATIVE | one_of("auto", "zscore"),
        "s = c * retrieval + score (the paper: about 1e6 with D2-Net's scores); auto = equal spread per query; zscore: "
        "scores are standardized over the candidates of each query and added",
    )
    weights: Any = setting(
        None,
        Rule(_is_weights, "weights above 0 by name, such as {retrieval: 0.5, anchor: 1}, or null"),
        "of zscore, 1 each: {retrieval: 0.5, anchor: 1} adds the score of anchor",
    )
    retrieval_score: RetrievalScore = setting("cosine", word_of(RetrievalScore))

    __post_init__ = check_fields


@dataclass(frozen=True)
class SystemSettings:
    """Settings of a system: its groups, by name, and how its scores rank."""

    features: Mapping[str, Any] = group()
    retrieval: Mapping[str, Any] = group()
    matching: Mapping[str, Any] = group()
    scorer: Mapping[str, Any] = group()
    candidates: int | Literal["all"] = setting(
        50, COUNT | "all", "number of database images that are re-ranked per query, or all"
    )
    fusion: FusionSettings = field(default=FusionSettings())
    final: str = setting("score", one_of("score", "combined"), "what decides: the score, or combined with retrieval")
    ties: Ties = setting("retrieval", word_of(Ties), "equal scores keep the order of retrieval, or of the database")

    def __post_init__(self) -> None:
        """Raise an InputError for settings that are not allowed, by themselves or together."""
        check_fields(self)
        for name in GROUPS:
            check_group(name, getattr(self, name))
        self._check_grid_scorer()
        self._check_places_of_patches()

    def _check_grid_scorer(self) -> None:
        """The scorer `grid` takes the cells of features in a square grid."""
        local, matching = self.features, self.matching
        if self.scorer.get("method") != "grid":
            return
        if local["name"] not in ("ssm", "import") and matching["name"] != "import":
            raise InputError(f"scorer=grid: expected features=ssm, whose features are cells, got {local['name']}")
        if (check := matching.get("cross_check", matching["name"])) != "candidate":
            raise InputError(f"matching.cross_check={check}: expected candidate, so that every cell has a match")
        sides = [(-(-pixels // 8) - 3) // local.get("stride", 1) + 1 for pixels in local["image_size"] or []]
        if local["name"] == "ssm" and sides != [self.scorer["side"]] * 2:
            cells = f"the {sides[0]} x {sides[1]} cells of features.image_size={local['image_size']}"
            raise InputError(f"scorer.side={self.scorer['side']}: expected {cells}")

    def _check_places_of_patches(self) -> None:
        """The scorer `rapid` divides by the largest place of a patch, which depends on the patches' size."""
        local = self.features
        if local["name"] != "patch_netvlad":
            return
        sizes = [[16 * (pixels // 16 - patch) for pixels in local["image_size"]] for patch in local["patch_sizes"]]
        for values in (self.scorer,) if "method" in self.scorer else self.scorer.values():
            reach = values.get("size")
            if reach is not None and min(map(min, sizes)) >= 0 and [[*reach]] != sizes:
                words = f"{sizes[0]}, the largest place of these patches, or null" if len(sizes) == 1 else "null"
                raise InputError(f"scorer.size={reach}: expected {words}")
