"""Seconds of a query by step, as the paper gives them, and as the database grows."""

import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.datasets import Dataset, ImageFolder
from mfvpr.evaluation import Pipeline, System, evaluation
from mfvpr.localization.vectors import Vectors
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

QUERIES, DATABASE = 10, 60  # images; as many of the database as there are candidates, at least
STEPS = ("retrieval", "features", "matching", "scores")
_FLOAT = 4  # bytes of a number
_MOST_BYTES = 1 << 30  # bytes of synthetic descriptors
_DATABASES = (100, 1000, 10_000, 100_000)  # images
_ROUNDS = 5


def measure_query(settings: Mapping[str, Any], dataset: Dataset) -> dict[str, float]:
    """Measure the seconds of a query by step.

    A part of the database is enough: only the search among descriptors depends on its size (see `search`). Queries are
    evaluated twice under different names, so that nothing is compiled, and no feature of the database is extracted,
    while the second pass is timed.
    """
    sequence = dataset.sequences[-1]  # RobotCar's snow, as the paper
    number = min(QUERIES, len(sequence.images))
    candidates = settings["candidates"]
    least = DATABASE if candidates == "all" else max(DATABASE, candidates)
    database = replace(dataset.database, names=tuple(dataset.database.names[:least]))
    extractor = assembly.extractor(settings["features"], None)
    retriever, matcher = (
        assembly.retriever(settings["retrieval"], extractor, None),
        assembly.matcher(settings["matching"]),
    )
    scorers, seconds = assembly.scorers(settings["scorer"]), dict[str, float]()
    main = "histogram" if "histogram" in scorers else next(iter(scorers))
    with tempfile.TemporaryDirectory(prefix="mfvpr-timing-") as folder:
        cache = FeatureCache(Path(folder) / "cache")
        system = System(Pipeline(extractor, retriever, matcher, candidates), {main: scorers[main]})
        for turn in ("first", "second"):
            images = _link_under_new_names(sequence.images, number, Path(folder) / turn)
            part = replace(sequence, images=images, truth=None, excluded=None)
            seconds = evaluation.rank_dataset(Dataset(dataset.name, database, (part,)), system, cache=cache).seconds
    return {step: seconds.get(step, 0.0) / number for step in STEPS}


def device() -> dict[str, Any]:
    """The device that the seconds are measured on, and versions."""
    return {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "versions": versions()}


def _link_under_new_names(images: ImageFolder, number: int, folder: Path) -> ImageFolder:
    """The first images under other names, in a folder of their own."""
    folder.mkdir()
    names = [f"{folder.name}{row:04d}{path.suffix}" for row, path in enumerate(images.paths[:number])]
    for name, path in zip(names, images.paths, strict=False):
        (folder / name).symlink_to(path.absolute())
    return replace(images, root=folder, names=tuple(names))


def search(descriptor: int) -> dict[int, float]:
    """Measure the seconds of a search among synthetic descriptors, by the size of the database.

    `descriptor` is the size of one in bytes; all of a database take at most `_MOST_BYTES`.
    """
    seconds, rng, length = {}, np.random.default_rng(0), descriptor // _FLOAT
    for size in (size for size in _DATABASES if size * descriptor <= _MOST_BYTES):
        database = Vectors()
        for row in range(size):
            database.put(row, rng.standard_normal(length, np.float32))
        query, times = rng.standard_normal(length, np.float32), []
        for _ in range(_ROUNDS + 1):
            start = time.perf_counter()
            database.nearest(query, 50)
            times.append(time.perf_counter() - start)
        seconds[size] = float(np.median(times[1:]))
    return seconds
