"""Milliseconds from an image file to its prediction, in maps of 1,000 and 10,000 images."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmark.harness import duration, write_report
from mfvpr.checkpoints import REGISTRY, is_installed, load_model
from mfvpr.cli.console import progress
from mfvpr.core import HistogramOfShifts
from mfvpr.core.types import Features
from mfvpr.datasets import ImageFolder, image_folder, read_image, resize
from mfvpr.datasets.streets import streets_folder
from mfvpr.evaluation import Pipeline, System
from mfvpr.features import Aggregated, AlikedFeatures, Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.report import Table
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.storage.maps import Entry

SIZES, CANDIDATES, ROUNDS = (1000, 10_000), 50, 3
FRAMES = 100  # of the synthetic street; every image of a map is one of them with noise of its own
NOISE = 0.03  # standard deviation of what is added to a number of a descriptor
BATCH = 100


def run(rounds: int | None, out: Path) -> None:
    """Localize every query once with candidates on disk, then in rounds with candidates in memory."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="mfvpr-localize-") as root:
        street = streets_folder(Path(root), num_frames=FRAMES)
        images, queries = image_folder(street / "database"), image_folder(street / "queries")
        for name, extractor in _extractors():
            pipeline = Pipeline(extractor, Retrieval(Aggregated(extractor, VladFitting())), candidates=CANDIDATES)
            system = System(pipeline, {"histogram": HistogramOfShifts()})
            for size in SIZES:
                street_map = Map(Path(root) / f"{name}-{size}", system)
                _fill(street_map, images, size)
                rows.append({"detector": name, "images": size} | _percentiles(street_map, queries, rounds or ROUNDS))
    header = ["features", "images", "p50, ms", "p95, ms", "p50, candidates read", "p95", "features alone"]
    parts = [list(row.values()) for row in rows]
    lines = [[name, f"{images:,}", *(f"{value:.1f}" for value in values)] for name, images, *values in parts]
    write_report(out, f"{FRAMES} queries with {CANDIDATES} candidates", [Table(header, lines)], {"rows": rows})


def _extractors() -> Iterator[tuple[str, Any]]:
    yield "SIFT", Sift()
    if is_installed(REGISTRY["aliked-n16"]):
        model: Any = load_model("aliked-n16")
        yield "ALIKED n16", AlikedFeatures(model)


def _fill(street_map: Map, images: ImageFolder, size: int) -> None:
    """Add `size` images: those of a folder again and again, each with other noise."""
    street_map.learn(images)
    describing, rng = street_map.describing, np.random.default_rng(0)
    describer: Any = describing.describer
    described = [image for batch in describing.folder(images, FeatureCache()) for image in batch.values()]
    for start in progress(f"map of {size}", range(0, size, BATCH)):
        features = [_with_noise(described[row % len(described)][0], rng) for row in range(start, start + BATCH)]
        entries = [Entry(str(start + row), start + row, vector) for row, vector in enumerate(describer(features))]
        street_map.add_described(entries, features)


def _with_noise(features: Features, rng: np.random.Generator) -> Features:
    noisy = features.descriptors + NOISE * rng.standard_normal(features.descriptors.shape, np.float32)
    return replace(features, descriptors=noisy / np.linalg.norm(noisy, axis=1, keepdims=True))


def _percentiles(street_map: Map, queries: ImageFolder, rounds: int) -> dict[str, float]:
    """Milliseconds with candidates in memory, with candidates that are read from disk, and of the features alone."""
    extractor = street_map.extractor
    street_map.localize(queries.paths[0])
    cold = [duration(partial(street_map.localize, path)) for path in queries.paths[1:]]
    warm = [duration(partial(street_map.localize, path)) for _ in range(rounds) for path in queries.paths]
    pixels = [resize(read_image(path), extractor.image_size, extractor.interpolation) for path in queries.paths[:20]]
    features = [duration(lambda image=image: jax.block_until_ready(extractor(image[None]))) for image in pixels]
    shares = {
        f"p{share}{title}": (seconds, share) for title, seconds in (("", warm), (" read", cold)) for share in (50, 95)
    }
    shares["features alone"] = features, 50
    return {name: float(1e3 * np.percentile(seconds, share)) for name, (seconds, share) in shares.items()}
