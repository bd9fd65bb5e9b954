"""Learn the parts of extractors and retrievals that depend on the database, and store them."""

import json
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.feature_extraction import describe_folder
from mfvpr.features.windows import WindowExtractor, WindowFitting, origin
from mfvpr.storage.disk import lock_store
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.whitening import Whitening

FORMAT = "mfvpr whitening 1"
_MB = 1e6

Tool = TypeVar("Tool")


def fit_to_database(tool: Tool, database: ImageFolder, cache: FeatureCache) -> Tool:
    """Learn the parts of an extractor, a retrieval, or a dataclass of these that need a database.

        cells = fit_to_database(SsmCells(model), database, cache)  # as `mfvpr.evaluate` does

    If the cache has a root, a learned part is stored there as one `.npz` file, named by a hash of the images' content
    and of all settings; this hash is part of the recipe of everything that is computed with it. Parts that are learned
    already stay the same, even if they were learned from another database. Images that cannot be read, are too few or
    too many, and a stored file that is damaged or of another kind raise an `InputError`.
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


def whitening_recipe(
    extractor: WindowExtractor, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache
) -> dict[str, Any]:
    """Recipe of a whitening: images, network and its input, windows, and samples."""
    parts = {"windows": cache.recipes.of(extractor.windows), "whitening": cache.recipes.of(fitting)}
    return {"format": FORMAT} | cache.recipes.of_folder(database, extractor.maps) | parts


def _whitening(
    extractor: WindowExtractor, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache
) -> Whitening:
    """Whitening from the cache, learned and stored there if it is missing."""
    if cache.root is None:
        return _learn(extractor, fitting, database, cache)
    recipe = whitening_recipe(extractor, fitting, database, cache)
    about, name = fingerprint(recipe), type(extractor).__name__
    path = cache.root / f"{name}-whitening-{about}.npz"
    cache.root.mkdir(parents=True, exist_ok=True)
    with lock_store(cache.root, "whitening", cache.log) if not path.exists() else nullcontext():
        if not path.exists():  # never replaced, because bits may differ between machines
            learned = _learn(extractor, fitting, database, cache)
            arrays = {"mean": learned.mean, "components": learned.components, "recipe": np.array(json.dumps(recipe))}
            write_arrays(path, arrays, about)
            cache.log(
                f"{name}: whitening of {learned.dimension} dimensions: {path.stat().st_size / _MB:.1f} MB in {path}"
            )
    arrays = read_arrays(path, about)
    return Whitening(arrays["mean"], arrays["components"], origin(extractor))


def _learn(extractor: WindowExtractor, fitting: WindowFitting, database: ImageFolder, cache: FeatureCache) -> Whitening:
    rows, bad = fitting.sample_rows(len(database)), {}

    def maps() -> Iterator[dict[int, np.ndarray]]:
        track = cache.runtime.progress(f"{type(extractor).__name__} whitening")
        for batch in describe_folder(database, extractor.maps, rows, bad, skip_bad=cache.skip_bad, track=track):
            yield {
                row: description.vector.reshape(extractor.windows.shape)
                for row, description in batch.items() if description.vector is not None
            }  # fmt: skip

    return replace(fitting.fit(maps(), extractor.windows, rows), origin=origin(extractor))
