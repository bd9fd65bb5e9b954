"""Turn checked settings into the parts of a system, by fixed tables: nothing named in a YAML file is called."""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from mfvpr import features
from mfvpr.baselines import SCORERS
from mfvpr.baselines.learned_weight import named_weight
from mfvpr.checkpoints import REGISTRY, load_model, own_entries
from mfvpr.core import Scorer
from mfvpr.core.scorer import parameters_of
from mfvpr.core.weights import WEIGHTS
from mfvpr.datasets import Dataset
from mfvpr.evaluation import DriveFilter, FrameCorrelation, Fusion, Pipeline, System
from mfvpr.features import Aggregated, Extractor, Sift, VladFitting
from mfvpr.matchers import LightGlueMatcher, Matcher, NearestNeighborMatcher
from mfvpr.retrieval import (
    DescriptorFiles,
    FeatureFiles,
    MatchFiles,
    Retrieval,
    Retriever,
    ShortlistFiles,
    SsmVoting,
    WhitenedSearch,
)
from mfvpr.retrieval.precomputed import File
from mfvpr.retrieval.search import EXACT
from mfvpr.systems.choices import NETWORKS, SystemSettings, by_scorer, without
from mfvpr.utils import recipe_of
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user
from mfvpr.utils.fingerprints import fingerprint


def extractor(settings: Mapping[str, Any], data: Dataset | None) -> Extractor | FeatureFiles:
    """The extractor of local features, or the feature files of another program."""
    name, options = settings["name"], without(settings, "name", "image_size")
    size = tuple(settings["image_size"]) if isinstance(settings["image_size"], list) else None
    if name == "import":
        return FeatureFiles(_files("features", options, data), options["lengths"], size)
    if size is not None:  # else the extractor's own, until images decide
        options["image_size"] = size
    if name != "sift":
        return _network_extractor("features", name, options)
    if (kind := options["interpolation"]).startswith("torch"):
        raise InputError(f"features.interpolation={kind}: gives fractions, but SIFT takes whole numbers")
    return Sift(**options)


def retriever(settings: Mapping[str, Any], local: Extractor | FeatureFiles, data: Dataset | None) -> Retriever:
    """The retrieval of candidates; VLAD aggregates the local features that are matched as well."""
    name, options = settings["name"], without(settings, "name", "whiten")
    if name == "pairs":
        return ShortlistFiles(_files("retrieval", {"database": None, **settings}, data), settings["database_prefix"])
    if name == "ssm":
        return SsmVoting(_network_extractor("retrieval", name, options))
    search = EXACT if settings["whiten"] is None else WhitenedSearch(settings["whiten"])
    if name == "import":
        return DescriptorFiles(_files("retrieval", options, data), options["lengths"], search)
    if name == "vlad":
        return Retrieval(Aggregated(local, VladFitting(**options)), search)
    if name != "same":
        return Retrieval(_network_extractor("retrieval", name, options), search)
    if isinstance(local, FeatureFiles) or not local.vector_size:
        expected = "features with a global descriptor, such as patch_netvlad, selavpr or dinov2"
        raise InputError(f"retrieval=same: expected {expected}; choose another retrieval")
    return Retrieval(local, search)


def _network_extractor(group: str, name: str, settings: Mapping[str, Any]) -> Any:
    """An extractor with a network; the settings are of its fields, of its network, and of its fitting."""
    extractor_class: Any = getattr(features, NETWORKS[group][name][0])
    options: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()
    }
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
    known = [entry.name for entry in (*REGISTRY.values(), *own_entries()) if entry.network in names]
    if weights not in known:
        raise InputError(f"{group}.weights={weights}: expected weights of {names[0]}: one of {', '.join(known)}")
    return load_model(weights)


def matcher(settings: Mapping[str, Any], data: Dataset | None) -> Matcher | MatchFiles:
    """The matcher of an image pair, or the match files of another program."""
    if settings["name"] == "neighbors":
        return NearestNeighborMatcher(**without(settings, "name"))
    if settings["name"] == "lightglue":
        model = _network("matching", ("lightglue",), settings["weights"])
        return LightGlueMatcher.of(model, **without(settings, "name", "weights"))
    queries = settings["query_features"] or settings["features"]
    feature_files = {**settings, "database": settings["features"], "queries": queries}
    return MatchFiles(
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
        raise InputError(
            f"{group}.queries: expected one file, or one for each of {count} sequences, got {len(queries)}"
        )
    files = {}
    if settings["database"] is not None:
        files[data.database.root] = File(expand_user(settings["database"]), settings["database_prefix"])
    for index, sequence in enumerate(data.sequences):
        root, path = sequence.images.root, expand_user(queries[index if len(queries) > 1 else 0])
        file = File(path, settings["query_prefix"])
        if files.setdefault(root, file) != file:
            same = f"since the queries and the database are one folder, {root}"
            raise InputError(f"{group}.queries={path}: expected the file and the prefix of {group}.database, {same}")
    return files


def pipeline(settings: SystemSettings, data: Dataset | None) -> Pipeline:
    """The pipeline that the settings name; files of other programs need their data set."""
    with in_group("features", settings.features):
        local = extractor(settings.features, data)
    with in_group("retrieval", settings.retrieval):
        retrieval = retriever(settings.retrieval, local, data)
    with in_group("matching", settings.matching):
        match = matcher(settings.matching, data)
    size = settings.features["image_size"]
    pixels = math.prod(local.image_size or ()) if size == "auto" else size if isinstance(size, int) else None
    return Pipeline(local, retrieval, match, settings.candidates, pixels)


def system(settings: SystemSettings, previous_queries: int = 0, sequence: str | Sequence[str] | None = None) -> System:
    """The system that the settings name, without files of other programs; further arguments as of `rankings`."""
    return System(pipeline(settings, None), **rankings(settings, previous_queries, sequence))


def rankings(
    settings: SystemSettings, previous_queries: int = 0, sequence: str | Sequence[str] | None = None
) -> dict[str, Any]:
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
    methods: list[Any] = [sequence] if isinstance(sequence, str) else [*(sequence or ())]
    if len({*methods}) < len(methods):
        raise InputError(f"sequence=[{','.join(methods)}]: expected every method once")
    return {
        "scorers": chosen,
        "fused": {main: fusion},
        "correlated": {headline: FrameCorrelation(previous_queries)} if previous_queries else {},
        "ties": settings.ties,
        "sequences": {headline: tuple(map(DriveFilter, methods))} if methods else {},
        "final": headline,
        "settings": to_values(settings),
    }


def expand_weights(settings: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Settings by scorer; a list of weights makes a scorer of each, such as `histogram_fs` and `histogram_ratio`."""
    variants: dict[str, Mapping[str, Any]] = {}
    for scorer, values in by_scorer(settings).items():
        weights = values.get("weight")
        for weight in weights if isinstance(weights, list) else [None]:
            name = scorer if weight is None else f"{scorer}_{Path(weight).stem}"
            if name in variants:
                raise InputError(f"scorer: expected every scorer once, got {name} twice; rename a file of weights")
            variants[name] = values if weight is None else {**values, "weight": weight}
    return variants


def describe_settings(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings of the scorers by name, with the content of a learned match weight, since its file may change."""
    return {
        name: {**values, "weight_content": fingerprint(recipe_of(named_weight(values["weight"])))}
        if values.get("weight", "fs") not in WEIGHTS
        else {**values}
        for name, values in expand_weights(settings).items()
    }


def scorers(settings: Mapping[str, Any]) -> dict[str, Scorer]:
    """The chosen scorer, or several, by name: a weight is a word, null is no limit, a list a tuple of numbers."""
    scorers = {}
    for name, values in expand_weights(settings).items():
        scorer, plain = SCORERS[values["method"]], without(values, "method")
        known = parameters_of(scorer)
        options: dict[str, Any] = {
            field: named_weight(value) if field == "weight" else known[field].value(value)
            for field, value in plain.items()
        }
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
