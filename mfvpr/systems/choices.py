"""The choices of each group of settings: which settings a choice has, from the fields of the classes that it makes.

A choice that is named in a file is looked up here; nothing else can be made.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from mfvpr import features
from mfvpr.baselines.learned_weight import SUFFIX, WORDS
from mfvpr.baselines.scorers import SCORERS
from mfvpr.evaluation.rankings import RetrievalScore, Ties
from mfvpr.features.windows import WindowFitting
from mfvpr.io.features import Lengths
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
KEYS = {"scorer": "method"}  # the setting of a group that is its choice; otherwise `name`

NETWORKS = {  # class of mfvpr.features, which Flax makes slow to import, and weights, by group and choice
    "features": {
        "aliked": ("AlikedFeatures", "aliked-n16"),
        "d2net": ("D2NetFeatures", "d2_tf"),
        "ssm": ("SsmCells", "vgg16_places365"),
        "patch_netvlad": ("PatchNetVladFeatures", "patchnetvlad_mapillary_512"),
        "selavpr": ("SelaVprFeatures", "selavpr_msls"),
        "dinov2": ("Dinov2Features", "dinov2_vitl14"),
    },
    "retrieval": {
        "mixvpr": ("MixVprDescriptor", "mixvpr_4096"),
        "netvlad": ("GlobalDescriptor", "netvlad_pitts30k"),
        "gem": ("GlobalDescriptor", "cosplace_resnet50_2048"),
        "dinov2": ("GlobalDescriptor", "dinov2_vitl14"),
        "ssm": ("SsmWindows", "vgg16_places365"),
    },
}
_WHITEN = "principal components that are kept, each of unit variance, fitted on the database; null = as they are"
_SHAPED = SIZE | whole(10_000, 4096**2) | "auto"  # a number of pixels; fewer than 10,000 are a side that was meant


@dataclass(frozen=True)
class _Imported:
    """Settings of files of another program."""

    database_prefix: str = setting("", TEXT | "", "what stands before the images' names in the file, such as database/")
    query_prefix: str = setting("", TEXT | "")
    lengths: Lengths = setting("unit", word_of(Lengths), "of descriptors")
    image_size: list[int] | None = setting(None, SIZE | None, "width, height, where the files do not tell")


@dataclass(frozen=True)
class _Files(_Imported):
    database: str = setting(REQUIRED, PATH, "file or folder")
    queries: str = setting(REQUIRED, or_list(PATH), "likewise; [FILE,FILE,...] of several sequences")


@dataclass(frozen=True)
class _Matches(_Imported):
    matches: str = setting(REQUIRED, or_list(PATH), "file or folder; [FILE,FILE,...] of several sequences")
    features: str | None = setting(None, PATH | None, "hloc's feats*.h5 that were matched")
    query_features: str | None = setting(None, PATH | None, "those of the queries, if they are in another file")
    verified: bool = setting(False, FLAG, "true: matches that fit a geometric model, of COLMAP or vismatch")
    confidences: bool = setting(True, FLAG, "false: all matches count alike")


def without(settings: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The settings but for those of some names."""
    return {name: value for name, value in settings.items() if name not in names}


def _network(group: str, name: str) -> dict[str, Any]:
    """Settings of a network: of its weights, and of its extractor."""
    owner, weights = NETWORKS[group][name]
    known = settings_of(getattr(features, owner))
    return {"weights": Setting(weights, TEXT, "`mfvpr weights list` has all weights"), **without(known, "whitening")}


def _features() -> dict[str, dict[str, Any]]:
    known = {"sift": without(settings_of(features.Sift), "batch_size")}
    known |= {name: _network("features", name) for name in NETWORKS["features"]}
    known["ssm"] |= settings_of(WindowFitting)
    for name in ("sift", "aliked", "d2net"):  # of images of any shape
        known[name]["image_size"] = replace(known[name]["image_size"], rule=_SHAPED)
    return {**known, "import": settings_of(_Files)}


def _retrieval() -> dict[str, dict[str, Any]]:
    files, known = settings_of(_Files), {name: _network("retrieval", name) for name in NETWORKS["retrieval"]}
    known |= {"vlad": settings_of(features.VladFitting), "same": {}, "import": without(files, "image_size")}
    for name in ("gem", "dinov2"):
        del known[name]["components"]
    known["dinov2"] |= {
        "image_size": Setting([224, 224], SIZE, "width, height, multiples of 14"),
        "pooling": Setting("cls", one_of("cls", "gem"), "the class token, or the generalized mean of the patches'"),
        "power": Setting(3.0, POSITIVE, "of the generalized mean: from the mean, 1, towards the maximum"),
    }
    for name in known.keys() - {"ssm"}:
        known[name]["whiten"] = Setting(None, whole(1, 4096) | None, _WHITEN)
    known["ssm"] |= settings_of(WindowFitting)
    known["ssm"]["dimension"] = replace(known["ssm"]["dimension"], default=125)
    return {**known, "pairs": without(files, "database", "lengths", "image_size")}


def _matching() -> dict[str, dict[str, Any]]:
    weights = Setting("aliked_lightglue", TEXT, "`mfvpr weights list` has all weights")
    return {
        "neighbors": settings_of(NearestNeighborMatcher),
        "lightglue": {"weights": weights, **settings_of(LightGlueMatcher)},
        "import": settings_of(_Matches),
    }


def _scorers() -> dict[str, dict[str, Any]]:
    """Settings of each scorer; a match weight may also be one that is named, or a file."""
    all_known = {name: settings_of(scorer) for name, scorer in SCORERS.items()}
    rule = one_of(*WORDS) | text(f"(?s).*{SUFFIX}", f"a file that ends in {SUFFIX}")
    for known in all_known.values():
        if "weight" in known:
            known["weight"] = replace(known["weight"], rule=rule, note="a list: a scorer of each")
    return all_known


@cache
def choices_of(group: str) -> dict[str, dict[str, Any]]:
    """Settings of a group by choice and name. `name` in a group's settings, or `method` of a scorer, is the choice."""
    return {"features": _features, "retrieval": _retrieval, "matching": _matching, "scorer": _scorers}[group]()


def by_scorer(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Settings of the chosen scorer, or of several, by name."""
    return {settings["method"]: settings} if "method" in settings else settings


def _check_choice(group: str, prefix: str, values: Any) -> None:
    """Raise an InputError for a value of a choice that is not allowed, or a setting that the choice does not have."""
    choices, key = choices_of(group), KEYS.get(group, "name")
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
        for name in ("features", "retrieval", "matching"):
            _check_choice(name, name, getattr(self, name))
        for name, values in by_scorer(self.scorer).items():
            _check_choice("scorer", "scorer" if "method" in self.scorer else f"scorer.{name}", values)
        local, sides = self.features, self.features["image_size"]
        if self.scorer.get("method") == "grid":  # which takes the cells of features in a square grid
            if local["name"] not in ("ssm", "import") and self.matching["name"] != "import":
                raise InputError(f"scorer=grid: expected features=ssm, whose features are cells, got {local['name']}")
            check = self.matching.get("cross_check", self.matching["name"])
            if check != "candidate":
                raise InputError(f"matching.cross_check={check}: expected candidate, so that every cell has a match")
            cells = [(-(-pixels // 8) - 3) // local.get("stride", 1) + 1 for pixels in sides or []]
            if local["name"] == "ssm" and cells != [self.scorer["side"]] * 2:
                expected = f"the {cells[0]} x {cells[1]} cells of features.image_size={sides}"
                raise InputError(f"scorer.side={self.scorer['side']}: expected {expected}")
        if local["name"] == "patch_netvlad":  # of whose patches the scorer `rapid` takes the largest place
            largest = [[16 * (pixels // 16 - patch) for pixels in sides] for patch in local["patch_sizes"]]
            for values in by_scorer(self.scorer).values():
                size = values.get("size")
                if size is not None and [[*size]] != largest:
                    expected = f"{largest[0]}, the largest place of these patches, or null"
                    raise InputError(f"scorer.size={size}: expected {expected}")
