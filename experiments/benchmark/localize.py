"""Maps that are asked: milliseconds from an image file to the answer, among 1,000 and 10,000 images."""

import json
import platform
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.console import bar
from mfvpr.checkpoints import load_model
from mfvpr.datasets import ImageFolder, image_folder, read_image, resize
from mfvpr.datasets.streets import streets_folder
from mfvpr.features import Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.report import Table
from mfvpr.storage.maps import Entry
from mfvpr.types import Features
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

SIZES, CANDIDATES, ROUNDS = (1000, 10_000), 50, 3
FRAMES = 100  # of the drawn street, of which each image of a map is one, with noise of its own
_NOISE = 0.03  # of a number of a descriptor
_BATCH = 100


def run(rounds: int | None, out: Path) -> None:
    """Print a table and write it as JSON to `out`: every query is asked once cold, then in rounds."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="mfvpr-localize-") as root:
        street = streets_folder(Path(root), num_frames=FRAMES)
        for name, extractor in _extractors():
            images, queries = image_folder(street / "database"), image_folder(street / "queries")
            for size in SIZES:
                known = Map(Path(root) / f"{name}-{size}", extractor, VladFitting(), candidates=CANDIDATES)
                _fill(known, images, size)
                rows.append({"detector": name, "images": size} | _asked(known, queries, rounds or ROUNDS))
    report(rows, out)


def _extractors() -> Iterator[tuple[str, Any]]:
    yield "SIFT", Sift()
    from mfvpr.checkpoints import REGISTRY, is_installed
    from mfvpr.features import AlikedFeatures

    if is_installed(REGISTRY["aliked-n16"]):
        model: Any = load_model("aliked-n16")
        yield "ALIKED n16", AlikedFeatures(model)


def _fill(known: Map, images: ImageFolder, size: int) -> None:
    """As many images as asked for: those of a folder again and again, with other noise."""
    known.learn(images)
    describing, rng = known.describing, np.random.default_rng(0)
    described = [one for batch in describing.folder(images, range(len(images))) for one in batch.values()]
    for start in bar(f"map of {size}", size // _BATCH, range(0, size, _BATCH)):
        features = [_noisy(described[row % len(described)][0], rng) for row in range(start, start + _BATCH)]
        describer: Any = describing.describer
        entries = [Entry(str(start + row), start + row, vector) for row, vector in enumerate(describer(features))]
        known.add_described(entries, features)


def _noisy(features: Features, rng: np.random.Generator) -> Features:
    noisy = features.descriptors + _NOISE * rng.standard_normal(features.descriptors.shape, np.float32)
    return replace(features, descriptors=noisy / np.linalg.norm(noisy, axis=1, keepdims=True))


def _asked(known: Map, queries: ImageFolder, rounds: int) -> dict[str, float]:
    """Percentiles in ms: of answers whose candidates are read from disk, of others, and of the features alone."""
    known.localize(queries.paths[0])
    cold = [_seconds(lambda path=path: known.localize(path)) for path in queries.paths[1:]]
    warm = [_seconds(lambda path=path: known.localize(path)) for _ in range(rounds) for path in queries.paths]
    size = known.extractor.image_size
    pixels = [resize(read_image(path), size, known.extractor.interpolation)[None] for path in queries.paths[:20]]
    features = [_seconds(lambda image=image: jax.block_until_ready(known.extractor(image))) for image in pixels]
    return {
        "p50": _percentile(warm, 50), "p95": _percentile(warm, 95), "p50 read": _percentile(cold, 50),
        "p95 read": _percentile(cold, 95), "features alone": _percentile(features, 50),
    }  # fmt: skip


def _seconds(call: Any) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _percentile(seconds: list[float], share: float) -> float:
    return float(1e3 * np.percentile(seconds, share))


def report(rows: list[dict[str, Any]], out: Path) -> None:
    """Print the table, and write everything as JSON."""
    header = ["features", "images", "p50, ms", "p95, ms", "p50, candidates read", "p95", "features alone"]
    cells = [
        [one["detector"], f"{one['images']:,}", *(f"{value:.1f}" for value in [*one.values()][2:])] for one in rows
    ]
    print(Table(header, cells).text())
    found = {"device": str(jax.devices()[0].device_kind), "machine": platform.machine(), "versions": versions()}
    write_text(out, json.dumps(found | {"rows": rows}, indent=1) + "\n")
    print(f"results: {out}")
