"""Features and matches on disk: which store belongs to a run, what it will take, and what it took."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from experiments import build
from experiments.console import tell
from mfvpr.data.datasets import ImageFolder
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.report.runs import versions
from mfvpr.stores import features as feature_store
from mfvpr.stores import matches as match_store
from mfvpr.stores.features import FeatureStore, open_store, require_space
from mfvpr.stores.manifest import MATCHES, store_path
from mfvpr.stores.matches import MatchStore, open_match_store

MB = 1e6
PAPER_FEATURE = 2064  # bytes of one feature of D2-Net there: float32 descriptor, keypoint and score


@contextmanager
def opened(
    root: str | None,
    name: str,
    folder: ImageFolder,
    extractor: LocalExtractor | GlobalExtractor,
    settings: dict[str, Any],
    images: str,
    *,
    wait: bool,
) -> Iterator[FeatureStore | None]:
    """The store of a folder's features by this extractor, announced and accounted for; None where `root` is None.

    Args:
        root: folder of all stores.
        name: what is stored, for people; the store has the extractor's, so that other data sets share it.
        folder: the images.
        extractor: what makes the features.
        settings: of the extractor; with the weights and the images they are what the store is keyed by.
        images: fingerprint of the images.
        wait: for another process that has the store open, instead of refusing it.
    """
    if root is None:
        yield None
        return
    recipe, waiting = features_recipe(settings, images), tell if wait else None
    path = store_path(build.expanded(root), settings["name"], recipe)
    with open_store(path, recipe, num_images=len(folder), waiting=waiting) as store:
        missing = len(folder) - int(store.done.sum())
        if missing:
            needed = feature_store.forecast_bytes(missing, extractor.typical_count, extractor.dimension)
            require_space(store.folder, needed)
            tell(
                f"{name}: {missing} of {len(folder)} images to do, about {extractor.typical_count} features of "
                f"{extractor.dimension} dimensions each: about {needed / MB:.1f} MB in {store.folder}"
            )
        else:
            tell(f"{name}: all {len(folder)} images from {store.folder}")
        yield store
        if missing:
            tell(_account(name, store, settings))


@contextmanager
def opened_matches(
    root: str,
    name: str,
    recipe: dict[str, Any],
    num_queries: int,
    num_candidates: int,
    typical_matches: int,
    *,
    wait: bool,
) -> Iterator[MatchStore]:
    """The store of a run's matches, announced.

    Args:
        root: folder of all stores.
        name: whose matches, for people.
        recipe: what they are made from, see `matches_recipe`.
        num_queries: Q.
        num_candidates: C.
        typical_matches: of a pair, about.
        wait: for another process that has the store open, instead of refusing it.
    """
    path, waiting = matches_path(root, recipe), tell if wait else None
    sizes = {"num_queries": num_queries, "num_candidates": num_candidates}
    with open_match_store(path, recipe, **sizes, waiting=waiting) as store:
        missing = num_queries - int(store.done.sum())
        if missing:
            needed = match_store.forecast_bytes(missing, num_candidates, typical_matches)
            require_space(store.folder, needed)
            tell(f"{name}: {missing} of {num_queries} queries to match with {num_candidates} candidates: about "
                  f"{needed / MB:.1f} MB in {store.folder}")  # fmt: skip
        else:
            tell(f"{name}: all {num_queries} queries from {store.folder}")
        yield store


def matches_path(root: str, recipe: dict[str, Any]) -> Path:
    """Where a run's matches are kept, whatever its data set is called."""
    name = recipe["database"]["features"]["extractor"]["name"]
    return store_path(build.expanded(root), f"{name}_matches", recipe, MATCHES)


def features_recipe(settings: dict[str, Any], images: str) -> dict[str, Any]:
    """All that changes features; how many images go through a network at once does not."""
    recipe = {key: value for key, value in settings.items() if key != "batch_size"}
    if "weights" in recipe:
        from mfvpr.weights.files import fingerprint

        recipe["weights_sha256"] = fingerprint(recipe["weights"])
    decoders = {name: versions()[name] for name in ("mfvpr", "opencv-python-headless", "pillow")}
    return {"extractor": recipe, "images": images, "versions": decoders}


def matches_recipe(settings: dict[str, Any], images: dict[str, str], num_candidates: int) -> dict[str, Any]:
    """All that changes a shortlist and its matches: features and descriptors of both sides, and the matching."""
    matching = {key: value for key, value in settings["matching"].items() if key != "chunk_size"}
    recipe = {
        side: {
            "features": features_recipe(settings["features"], fingerprint),
            "descriptors": features_recipe(settings["retrieval"], fingerprint),
        }
        for side, fingerprint in images.items()
    } | {"candidates": num_candidates, "matching": matching, "on_bad_image": settings["on_bad_image"]}
    neighbors = settings["dataset"].get("exclude_neighbors")
    return recipe if neighbors is None else recipe | {"exclude_neighbors": neighbors}


def _account(name: str, store: FeatureStore, settings: dict[str, Any]) -> str:
    size, features = store.size_bytes, int(store.counts.clip(0).sum())
    images = max(int(store.done.sum()), 1)
    text = f"{name}: {size / MB:.1f} MB, {size / images / MB:.2f} MB and {features / images:.0f} features an image"
    if settings["name"] != "d2net":
        return text
    paper = features * PAPER_FEATURE
    return f"{text}; as the paper stores them, in float32, {paper / MB:.1f} MB: {size / paper:.2f}x"
