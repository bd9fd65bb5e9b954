"""Learn the parts of extractors and retrievals that depend on the database, and store them."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.feature_extraction import describe_folder
from mfvpr.features.whitening import Whitening
from mfvpr.features.windows import WindowExtractor, WindowFitting, origin
from mfvpr.storage.cache_files import CacheFiles
from mfvpr.storage.feature_cache import FeatureCache

Tool = TypeVar("Tool")


def fit_to_database(tool: Tool, database: ImageFolder, cache: FeatureCache) -> Tool:
    """Learn the parts of an extractor, a retrieval, or a dataclass of these that need a database.

        cells = fit_to_database(SsmCells(model), database, cache)  # as `mfvpr.evaluate` does

    If the cache has a root, a learned part is stored there as one `.npz` file, named by the images' content and all
    settings; its content is part of the recipe of everything that is computed with it. Parts that are learned already
    stay the same, even if they were learned from another database. Images that cannot be read, are too few or too many
    raise an `InputError`.
    """
    if isinstance(tool, WindowExtractor) and isinstance(tool.whitening, WindowFitting):
        fitting = tool.whitening
        whitening = cache.once("whitening", lambda: _whitening(tool, fitting, database, cache), database, tool)
        return replace(tool, whitening=whitening)  # pyright: ignore[reportArgumentType, reportCallIssue, reportReturnType]
    return with_parts(tool, lambda part: fit_to_database(part, database, cache))


def with_parts(whole: Any, change: Callable[[Any], Any]) -> Any:
    """Apply a function to the fields of a dataclass; the same object if none changes, or if it is no dataclass."""
    if not is_dataclass(whole) or isinstance(whole, type):
        return whole
    parts = {part.name: getattr(whole, part.name) for part in fields(whole) if part.init}
    changed = {name: new for name, part in parts.items() if (new := change(part)) is not part}
    return replace(whole, **changed) if changed else whole


def whitening_recipe(extractor: WindowExtractor, fitting: WindowFitting, cache: FeatureCache) -> dict[str, Any]:
    """Recipe of a whitening but for the database: network and its input, windows, and samples."""
    parts = {"windows": cache.recipes.of(extractor.windows), "whitening": cache.recipes.of(fitting)}
    return cache.recipes.of_features(extractor.maps) | parts


def _whitening(
    extractor: WindowExtractor, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache
) -> Whitening:
    """Whitening from the cache, learned and stored there if it is missing."""
    recipe = cache.recipe(lambda: whitening_recipe(extractor, fitting, cache))
    if recipe is None or cache.root is None:
        return _learn(extractor, fitting, database, cache)
    name, key = f"{type(extractor).__name__}-whitening", cache.recipes.contents(database).fingerprint
    files = CacheFiles(
        cache.root,
        name,
        recipe,
        pack=lambda whitening: {"mean": whitening.mean, "components": whitening.components},
        unpack=lambda arrays: Whitening(arrays["mean"], arrays["components"], origin(extractor)),
    )
    whitening = files.get(key)
    if whitening is None:
        is_damaged = key in files
        if is_damaged:
            cache.warn(f"{files.path(key)}: is damaged; learned again")
        whitening = _learn(extractor, fitting, database, cache)
        files.update({key: whitening}, once=not is_damaged)  # the first of several counts: bits may differ
        cache.log(f"{name} of {whitening.dimension} dimensions in {files.folder}")
        whitening = files.get(key) or whitening
    return whitening


def _learn(extractor: WindowExtractor, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache) -> Whitening:
    rows, bad = fitting.sample_rows(len(database)), {}

    def maps() -> Iterator[dict[int, np.ndarray]]:
        track = cache.runtime.progress(f"{type(extractor).__name__} whitening")
        for batch in describe_folder(database, extractor.maps, rows, bad, skip_bad=cache.skip_bad, track=track):
            vectors = {row: description.vector for row, description in batch.items()}
            yield {row: each.reshape(extractor.windows.shape) for row, each in vectors.items() if each is not None}

    return replace(fitting.fit(maps(), extractor.windows, rows), origin=origin(extractor))
