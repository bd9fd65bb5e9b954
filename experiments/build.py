"""Checked settings -> the library's values. Plain tables of names; nothing of a user's YAML is ever called."""

import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from experiments.settings import SettingsError
from mfvpr.data.datasets import Dataset, folder_dataset
from mfvpr.data.ground_truth import CHOICES
from mfvpr.data.streets import streets_folder
from mfvpr.declaration import made
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.features.sift import Sift
from mfvpr.features.vlad import fit_vlad
from mfvpr.scoring import SCORERS, Scorer
from mfvpr.sources import FeatureSet


def expanded(path: str) -> Path:
    """A path with ~ resolved, where there is such a user."""
    return Path(os.path.expanduser(path))


def dataset(settings: dict[str, Any], progress: Callable[[int, int], None]) -> Dataset:
    """The data set; `streets` is drawn first where the cache does not have it."""
    if "cache" in settings:
        root = streets_folder(expanded(settings["cache"]), seed=settings["seed"], progress=progress)
        return folder_dataset(
            root / "database", root / "queries", name="streets", ground_truth="index",
            index_file=root / "ground_truth.csv", widen_index=True,
        )  # fmt: skip
    if settings["ground_truth"] is None:
        raise SettingsError(f"dataset.ground_truth: nothing is assumed of your own images; set it to one of {CHOICES}")
    options = {name: value for name, value in settings.items() if name not in ("root", "exclude_neighbors")}
    for name in ("database", "queries", "index_file", "database_labels", "query_labels"):
        options[name] = expanded(options[name]) if options[name] else None
    return folder_dataset(**options)


def local_extractor(settings: dict[str, Any]) -> LocalExtractor:
    """What finds local features; networks with their converted weights."""
    name, options = settings["name"], {name: value for name, value in settings.items() if name != "name"}
    options["image_size"] = tuple(options["image_size"])
    if name == "sift":
        if options["interpolation"] == "torch_bilinear":
            raise SettingsError("features.interpolation=torch_bilinear: gives fractions, but SIFT takes whole numbers")
        return Sift(**_only(options, Sift, "features=sift"))
    # Here, since Flax takes half a second.
    from mfvpr.features.aliked import AlikedFeatures
    from mfvpr.features.d2net import D2NetFeatures

    extractor = {"aliked": AlikedFeatures, "d2net": D2NetFeatures}[name]
    weights = options.pop("weights", None)
    return extractor(_network("features", name, weights), **_only(options, extractor, f"features={name}"))


def global_extractor(settings: dict[str, Any]) -> Callable[[FeatureSet], GlobalExtractor]:
    """What describes whole images, once the database's features are there, of which VLAD learns its vocabulary."""
    options = {name: value for name, value in settings.items() if name != "name"}
    if settings["name"] == "vlad":
        return lambda database: fit_vlad(database, **options)
    from mfvpr.features.mixvpr import IMAGE_SIZE, MixVprDescriptor

    size = options.pop("image_size")
    if tuple(size) != IMAGE_SIZE:
        raise SettingsError(f"retrieval.image_size={size}: MixVPR takes {list(IMAGE_SIZE)} only, as its weights do")
    extractor = MixVprDescriptor(_network("retrieval", "mixvpr", options.pop("weights")), **options)
    return lambda database: extractor


def _network(group: str, name: str, weights: str | None) -> Any:
    """The network with its weights, converted before."""
    from mfvpr.weights.files import load_model
    from mfvpr.weights.registry import REGISTRY

    known = [entry.name for entry in REGISTRY.values() if entry.network == name]
    if weights not in known:
        raise SettingsError(f"{group}.weights={weights}: expected weights of {name}: one of {', '.join(known)}")
    return load_model(weights)


def scorers(settings: dict[str, Any]) -> dict[str, Scorer]:
    """The chosen scorer, or all of a group, by name."""
    chosen = {settings["method"]: settings} if "method" in settings else settings
    return {
        name: made(SCORERS[name], {field: plain for field, plain in values.items() if field != "method"})
        for name, values in chosen.items()
    }


def _only(options: dict[str, Any], extractor: type, choice: str) -> dict[str, Any]:
    """The options, which the extractor must all know: a mixture of two choices has others."""
    foreign = options.keys() - {field.name for field in fields(extractor)}
    if foreign:
        raise SettingsError(f"{choice} has no setting {', '.join(sorted(foreign))}; see --help")
    return options
