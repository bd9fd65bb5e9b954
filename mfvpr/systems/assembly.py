"""Systems from settings: the choices of each group with their settings, and the objects that are built from them.

A choice that is named in a file is looked up here; nothing else can be made.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from mfvpr import features, retrieval
from mfvpr.baselines.learned_weight import SUFFIX, WORDS, named_weight
from mfvpr.baselines.scorers import SCORERS
from mfvpr.checkpoints import REGISTRY, custom_entries, load_model
from mfvpr.core import Scorer
from mfvpr.core.scorer import parameters_of
from mfvpr.core.weights import WEIGHTS
from mfvpr.datasets import Dataset
from mfvpr.evaluation import DriveFilter, FrameCorrelation, Fusion, Pipeline, System
from mfvpr.evaluation.rankings import RetrievalScore, Ties
from mfvpr.features.whitening import WindowFitting
from mfvpr.io.features import Lengths
from mfvpr.matchers import LightGlueMatcher, Matcher, NearestNeighborMatcher
from mfvpr.retrieval.precomputed import File
from mfvpr.retrieval.search import EXACT
from mfvpr.retrieval.standardization import Rule as Standardization
from mfvpr.utils import recipe_of
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
    to_values,
    whole,
    word_of,
)
from mfvpr.utils.files import expand_user
from mfvpr.utils.fingerprints import fingerprint

_INSTALLED = Path(__file__).parent / "conf"  # in a wheel; in a clone, it stands beside the package
CONF = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[2] / "conf"
GROUPS = ("features", "retrieval", "matching", "scorer")
KEYS = {"scorer": "method"}  # the setting of a group that is its choice; otherwise `name`

NETWORKS = {  # class of mfvpr.features, which Flax makes slow to import, and weights, by group and choice
    "features": {
        "aliked": ("AlikedFeatures", "aliked-n16"),
        "xfeat": ("XFeatFeatures", "xfeat"),
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
        "efficientnet": ("EfficientNetDescriptor", "efficientnet_lite0"),
    },
}
_WHITEN = "keep N whitened principal components, fitted on the database; null = off"
_STANDARDIZE = "by the statistics of all queries, of those so far, or of the database alone, see features/README.md"
_WEIGHTS = "weights above 0 by name, such as {retrieval: 0.5, anchor: 1}"
_LIST = "`mfvpr weights list` has all weights"
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


@cache
def choices_of(group: str) -> dict[str, dict[str, Any]]:
    """Settings of a group by choice and name. `name` in a group's settings, or `method` of a scorer, is the choice."""
    known, files = dict[str, dict[str, Any]](), settings_of(_Files)
    for name, (owner, weights) in NETWORKS.get(group, {}).items():
        of_owner = without(settings_of(getattr(features, owner)), "whitening")
        known[name] = {"weights": Setting(weights, TEXT, _LIST), **of_owner}
    if "ssm" in known:
        known["ssm"] |= settings_of(WindowFitting)
    if group == "features":
        known = {"sift": without(settings_of(features.Sift), "batch_size"), **known, "import": files}
        for name in ("sift", "aliked", "xfeat", "d2net"):  # of images of any shape
            known[name]["image_size"] = replace(known[name]["image_size"], rule=_SHAPED)
    elif group == "retrieval":
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
            default = "auto" if name == "efficientnet" else "none"
            known[name]["standardize"] = Setting(default, word_of(Standardization), _STANDARDIZE)
        known["ssm"]["dimension"] = replace(known["ssm"]["dimension"], default=125)
        known["pairs"] = without(files, "database", "lengths", "image_size")
    elif group == "matching":
        lightglue = {"weights": Setting("aliked_lightglue", TEXT, _LIST), **settings_of(LightGlueMatcher)}
        matches = settings_of(_Matches)
        known = {"neighbors": settings_of(NearestNeighborMatcher), "lightglue": lightglue, "import": matches}
    else:
        known = {name: settings_of(scorer) for name, scorer in SCORERS.items()}
        rule = one_of(*WORDS) | text(f"(?s).*{SUFFIX}", f"a file that ends in {SUFFIX}")
        for each in known.values():
            if "weight" in each:  # also one that is named, or a file
                each["weight"] = replace(each["weight"], rule=rule, note="a list: a scorer of each")
    return known


def by_choice(group: str, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Settings of the chosen scorer or retrieval, or of several, by name."""
    key = KEYS.get(group, "name")
    return {settings[key]: settings} if key in settings else settings


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
    if missing := [name for name in known if name not in values]:
        raise InputError(f"{prefix}.{missing[0]}: expected a value of {choice}, got none")


@dataclass(frozen=True)
class FusionSettings:
    """Fusion of scores with that of the retrieval."""

    c: float | str = setting(
        "auto",
        NOT_NEGATIVE | one_of("auto", "zscore"),
        "s = c * retrieval + score; auto = equal spread per query; zscore = standardized scores are added",
    )
    weights: Any = setting(
        None,
        Rule(lambda value: isinstance(value, Mapping) and all(map(POSITIVE.holds, value.values())), _WEIGHTS) | None,
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
    candidates: int | Literal["all"] = setting(50, COUNT | "all", "database images that are re-ranked per query")
    fusion: FusionSettings = field(default=FusionSettings())
    final: str = setting("score", one_of("score", "combined"), "what decides: the score, or combined with retrieval")
    ties: Ties = setting("retrieval", word_of(Ties), "equal scores keep the order of retrieval, or of the database")
    previous_queries: int = 0  # only of evaluations, as is the next
    sequence: Any = None

    def __post_init__(self) -> None:
        """Raise an InputError for settings that are not allowed, by themselves or together."""
        check_fields(self)
        for name in ("features", "matching"):
            _check_choice(name, name, getattr(self, name))
        if "name" not in self.retrieval and len(self.retrieval) != 2:
            raise InputError(f"retrieval: expected one, or two in turns, got {', '.join(self.retrieval) or 'none'}")
        if not self.scorer:
            raise InputError("scorer: expected at least one, got none")
        for part in ("retrieval", "scorer"):
            chosen = getattr(self, part)
            for name, values in by_choice(part, chosen).items():
                _check_choice(part, part if values is chosen else f"{part}.{name}", values)
        local, scorers = self.features, by_choice("scorer", self.scorer).values()
        for grid in (values for values in scorers if values["method"] == "grid"):  # of cells of features in a square
            if local["name"] not in ("ssm", "import") and self.matching["name"] != "import":
                raise InputError(f"scorer=grid: expected features=ssm, whose features are cells, got {local['name']}")
            check = self.matching.get("cross_check", self.matching["name"])
            if check != "candidate":
                raise InputError(f"matching.cross_check={check}: expected candidate, so that every cell has a match")
            cells = [(-(-pixels // 8) - 3) // local.get("stride", 1) + 1 for pixels in local["image_size"] or []]
            if local["name"] == "ssm" and cells != [grid["side"]] * 2:
                raise InputError(f"scorer.side={grid['side']}: expected the {cells} cells of the images")
        if local["name"] == "patch_netvlad":  # of whose patches the scorer `rapid` takes the largest place
            sides = local["image_size"]
            largest = [[16 * (pixels // 16 - patch) for pixels in sides] for patch in local["patch_sizes"]]
            for values in scorers:
                size = values.get("size")
                if size is not None and [[*size]] != largest:
                    raise InputError(f"scorer.size={size}: expected the patches' largest place, {largest[0]}, or null")


# --- the parts of a system, by fixed tables: nothing named in a YAML file is called ---------------------------------


def extractor(settings: Mapping[str, Any], data: Dataset | None) -> features.Extractor | retrieval.FeatureFiles:
    """The extractor of local features, or the feature files of another program."""
    name, options = settings["name"], without(settings, "name", "image_size")
    size = tuple(settings["image_size"]) if isinstance(settings["image_size"], list) else None
    if name == "import":
        return retrieval.FeatureFiles(_files("features", options, data), options["lengths"], size)
    if size is not None:  # else the extractor's own, until images decide
        options["image_size"] = size
    if name != "sift":
        return _network_extractor("features", name, options)
    if (kind := options["interpolation"]).startswith("torch"):
        raise InputError(f"features.interpolation={kind}: gives fractions, but SIFT takes whole numbers")
    return features.Sift(**options)


def retriever(
    settings: Mapping[str, Any], local: features.Extractor | retrieval.FeatureFiles, data: Dataset | None
) -> retrieval.Retriever:
    """The retrieval of candidates; VLAD aggregates the local features that are matched as well."""
    if "name" not in settings:
        return retrieval.Alternating(*(retriever(each, local, data) for each in settings.values()))
    name, options = settings["name"], without(settings, "name", "whiten", "standardize")
    if name == "pairs":
        files = _files("retrieval", {"database": None, **settings}, data)
        return retrieval.ShortlistFiles(files, settings["database_prefix"])
    if name == "ssm":
        return retrieval.SsmVoting(_network_extractor("retrieval", name, options))
    search, standardize = EXACT, settings["standardize"]
    if settings["whiten"] is not None:
        search = retrieval.WhitenedSearch(settings["whiten"])
        if standardize not in ("none", "auto"):
            raise InputError(f"standardize={standardize}: expected none with whiten={settings['whiten']}")
    elif standardize != "none":
        search = retrieval.StandardizedSearch(standardize)
    if name == "import":
        return retrieval.DescriptorFiles(_files("retrieval", options, data), options["lengths"], search)
    if name == "vlad":
        return retrieval.Retrieval(features.Aggregated(local, features.VladFitting(**options)), search)
    if name != "same":
        return retrieval.Retrieval(_network_extractor("retrieval", name, options), search)
    if isinstance(local, retrieval.FeatureFiles) or not local.vector_size:
        raise InputError("retrieval=same: expected features with a global descriptor, such as selavpr or dinov2")
    return retrieval.Retrieval(local, search)


def _network_extractor(group: str, name: str, settings: Mapping[str, Any]) -> Any:
    """An extractor with a network; the settings are of its fields, of its network, and of its fitting."""
    extractor_class: Any = getattr(features, NETWORKS[group][name][0])
    options: Any = {key: tuple(each) if isinstance(each, list) else each for key, each in settings.items()}
    networks = ("netvlad", "patch_netvlad") if name == "netvlad" else (name,)
    model = _network(group, networks, options["weights"])
    if "pooling" in options:
        from mfvpr.networks.vit import TokenDescriptor

        model = TokenDescriptor(model, options["pooling"], options["power"])
    names = {field.name for field in fields(extractor_class)}
    if "whitening" in names:
        published = extractor_class.whitening
        fitting = {field.name: options[field.name] for field in fields(published) if field.name in options}
        options["whitening"] = replace(published, **fitting)
    return extractor_class(model, **{option: value for option, value in options.items() if option in names})


def _network(group: str, names: tuple[str, ...], weights: str) -> Any:
    """A network of one of these names, with its converted weights."""
    known = [entry.name for entry in (*REGISTRY.values(), *custom_entries()) if entry.network in names]
    if weights not in known:
        raise InputError(f"{group}.weights={weights}: expected weights of {names[0]}: one of {', '.join(known)}")
    return load_model(weights)


def matcher(settings: Mapping[str, Any], data: Dataset | None) -> Matcher | retrieval.MatchFiles:
    """The matcher of an image pair, or the match files of another program."""
    if settings["name"] == "neighbors":
        return NearestNeighborMatcher(**without(settings, "name"))
    if settings["name"] == "lightglue":
        model = _network("matching", ("lightglue",), settings["weights"])
        return LightGlueMatcher.of(model, **without(settings, "name", "weights"))
    queries = settings["query_features"] or settings["features"]
    feature_files = {**settings, "database": settings["features"], "queries": queries}
    return retrieval.MatchFiles(
        _files("matching", {"database": None, "queries": settings["matches"], **settings}, data),
        settings["database_prefix"],
        {} if queries is None else _files("matching", feature_files, data),
        None if settings["image_size"] is None else tuple(settings["image_size"]),
        **{name: settings[name] for name in ("verified", "confidences", "lengths")},
    )


def _files(group: str, settings: Mapping[str, Any], data: Dataset | None) -> dict[Path, File]:
    """Files of another program, by folder of the images."""
    if data is None:
        raise InputError(f"{group}: files of other programs belong to a data set; choose others")
    queries = settings["queries"] if isinstance(settings["queries"], list) else [settings["queries"]]
    if len(queries) not in (1, count := len(data.sequences)):
        raise InputError(f"{group}.queries: expected one file, or one per sequence ({count}), got {len(queries)}")
    files = {}
    if settings["database"] is not None:
        files[data.database.root] = File(expand_user(settings["database"]), settings["database_prefix"])
    for index, sequence in enumerate(data.sequences):
        root, path = sequence.images.root, expand_user(queries[index if len(queries) > 1 else 0])
        file = File(path, settings["query_prefix"])
        if files.setdefault(root, file) != file:
            expected = f"file and prefix of {group}.database, both are of {root}"
            raise InputError(f"{group}.queries={path}: expected {expected}")
    return files


def pipeline(settings: SystemSettings, data: Dataset | None) -> Pipeline:
    """The pipeline that the settings name; files of other programs need their data set."""
    with in_group("features", settings.features):
        local = extractor(settings.features, data)
    with in_group("retrieval", settings.retrieval):
        search = retriever(settings.retrieval, local, data)
    with in_group("matching", settings.matching):
        match = matcher(settings.matching, data)
    size = settings.features["image_size"]
    pixels = math.prod(local.image_size or ()) if size == "auto" else size if isinstance(size, int) else None
    return Pipeline(local, search, match, settings.candidates, pixels)


def system(settings: SystemSettings) -> System:
    """The system that the settings name, without files of other programs."""
    return System(pipeline(settings, None), **rankings(settings))


def rankings(settings: SystemSettings) -> dict[str, Any]:
    """All of a system but its pipeline: the main scorer is fused with the retrieval.

    The ranking that decides is also made with the places of previous queries, and of the queries as a sequence.
    """
    chosen, fused = scorers(settings.scorer), settings.fusion
    c = {"auto": None, "zscore": "zscore"}[fused.c] if isinstance(fused.c, str) else float(fused.c)
    fusion: Any = Fusion(c, fused.retrieval_score, fused.weights or {})
    histograms = (name for name, scorer in chosen.items() if isinstance(scorer, SCORERS["histogram"]))
    main = next(histograms, next(iter(chosen)))
    with in_group("fusion", ("c", "weights", "retrieval_score")):
        fusion.check(main, tuple(chosen))
    headline = fusion.system(main) if settings.final == "combined" else main
    sequence, previous = settings.sequence, settings.previous_queries
    methods: list[Any] = [sequence] if isinstance(sequence, str) else [*(sequence or ())]
    if len({*methods}) < len(methods):
        raise InputError(f"sequence=[{','.join(methods)}]: expected every method once")
    return {
        "scorers": chosen,
        "fused": {main: fusion},
        "correlated": {headline: FrameCorrelation(previous)} if previous else {},
        "ties": settings.ties,
        "sequences": {headline: tuple(map(DriveFilter, methods))} if methods else {},
        "final": headline,
        "settings": to_values(settings),
    }


def expand_weights(settings: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Settings by scorer; a list of weights makes a scorer of each, such as `histogram_fs` and `histogram_ratio`."""
    variants: dict[str, Mapping[str, Any]] = {}
    for scorer, values in by_choice("scorer", settings).items():
        weights = values.get("weight")
        for weight in weights if isinstance(weights, list) else [None]:
            name = scorer if weight is None else f"{scorer}_{Path(weight).stem}"
            if name in variants:
                raise InputError(f"scorer: expected every scorer once, got {name} twice; rename a file of weights")
            variants[name] = values if weight is None else {**values, "weight": weight}
    return variants


def describe_settings(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings of the scorers by name, with the content of a learned match weight, since its file may change."""
    described = {name: {**values} for name, values in expand_weights(settings).items()}
    for values in described.values():
        if values.get("weight", "fs") not in WEIGHTS:
            values["weight_content"] = fingerprint(recipe_of(named_weight(values["weight"])))
    return described


def scorers(settings: Mapping[str, Any]) -> dict[str, Scorer]:
    """The chosen scorer, or several, by name: a weight is a word, null is no limit, a list a tuple of numbers."""
    scorers = {}
    for name, values in expand_weights(settings).items():
        scorer = SCORERS[values["method"]]
        known, plain = parameters_of(scorer), without(values, "method")
        options: dict[str, Any] = {field: known[field].value(value) for field, value in plain.items()}
        if "weight" in options:
            options["weight"] = named_weight(values["weight"])
        with in_group("scorer" if name == values["method"] else f"scorer.{name}", values):
            scorers[name] = scorer(**options)
    return scorers


@contextmanager
def in_group(group: str, names: Collection[str]) -> Iterator[None]:
    """Put the group in front of the name of a setting that an error of a dataclass begins with."""
    try:
        yield
    except InputError as error:
        if re.split("[=:]", str(error), maxsplit=1)[0] not in names:
            raise
        raise InputError(f"{group}.{error}") from error
