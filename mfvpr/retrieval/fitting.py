"""What must see the database before it can work: learned once, kept by what it was learned from, never for another.

    cells = fitted(SsmCells(model), database, archive)

`mfvpr.evaluate` does it for the extractor and the filter that it is given.
"""

import json
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extraction import described
from mfvpr.features.windows import WindowExtractor, WindowFitting, origin
from mfvpr.storage.disk import locked
from mfvpr.storage.feature_cache import Archive
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.whitening import Whitening

FORMAT = "mfvpr whitening 1"
_MB = 1e6

Tool = TypeVar("Tool")


def fitted(tool: Tool, database: ImageFolder, archive: Archive) -> Tool:
    """An extractor, a filter, or any dataclass that holds some: the same, where it or a part is to be learned, learned.

    Where the archive has a root, what is learned is kept below it, one `.npz` file by the images' content and by all
    that makes it what it is; a hash of it is part of the recipe of whatever is computed with it.

    Args:
        tool: what is learned already stays, also where somebody learned it from another database on purpose.
        database: whose images it learns from.
        archive: see `Archive`.

    Raises:
        InputError: images cannot be read, are too few or too many, or what was kept is damaged or of something else.
    """
    if isinstance(tool, WindowExtractor) and isinstance(tool.whitening, WindowFitting):
        how = tool.whitening
        learned = archive.once("whitening", lambda: _whitening(tool, how, database, archive), database, tool)
        return replace(tool, whitening=learned)  # pyright: ignore[reportArgumentType, reportCallIssue, reportReturnType]
    if not is_dataclass(tool) or isinstance(tool, type):
        return tool
    parts = {part.name: getattr(tool, part.name) for part in fields(tool) if part.init}
    learned = {name: fitted(part, database, archive) for name, part in parts.items()}
    changed = {name: part for name, part in learned.items() if part is not parts[name]}
    return replace(tool, **changed) if changed else tool


def whitening_recipe(
    extractor: WindowExtractor, how: WindowFitting, database: ImageFolder, archive: Archive
) -> dict[str, Any]:
    """All that changes what is learned: the images, the network and what it is fed with, windows, draws."""
    parts = {"windows": archive.recipe_of(extractor.windows), "whitening": archive.recipe_of(how)}
    return {"format": FORMAT} | archive.recipe(database, extractor.maps) | parts


def _whitening(extractor: WindowExtractor, how: WindowFitting, database: ImageFolder, archive: Archive) -> Whitening:
    if archive.root is None:
        return _learned(extractor, how, database, archive)
    recipe = whitening_recipe(extractor, how, database, archive)
    about, name = fingerprint(recipe), type(extractor).__name__
    path = archive.root / f"{name}-whitening-{about}.npz"
    archive.root.mkdir(parents=True, exist_ok=True)
    with locked(archive.root, "whitening", archive.tell) if not path.exists() else nullcontext():
        if not path.exists():  # the first counts: bits may differ from machine to machine
            learned = _learned(extractor, how, database, archive)
            arrays = {"mean": learned.mean, "components": learned.components, "recipe": np.array(json.dumps(recipe))}
            write_arrays(path, arrays, about)
            archive.tell(
                f"{name}: whitening of {learned.dimension} dimensions: {path.stat().st_size / _MB:.1f} MB in {path}"
            )
    kept = read_arrays(path, about)
    return Whitening(kept["mean"], kept["components"], origin(extractor))


def _learned(extractor: WindowExtractor, how: WindowFitting, database: ImageFolder, archive: Archive) -> Whitening:
    rows, bad = how.drawn(len(database)), {}

    def maps() -> Iterator[dict[int, np.ndarray]]:
        track = archive.track(f"{type(extractor).__name__} whitening")
        for batch in described(database, extractor.maps, rows, bad, skip_bad=archive.skip_bad, track=track):
            yield {
                row: description.vector.reshape(extractor.windows.shape)
                for row, description in batch.items() if description.vector is not None
            }  # fmt: skip

    return replace(how.fit(maps(), extractor.windows, rows), origin=origin(extractor))
