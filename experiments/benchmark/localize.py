"""Milliseconds from an image file to its prediction, in maps of 1,000 and 10,000 images."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmark.harness import Rows, duration
from mfvpr.checkpoints import REGISTRY, is_installed, load_model
from mfvpr.core import HistogramOfShifts
from mfvpr.datasets import ImageFolder, image_folder, read_image, resize
from mfvpr.datasets.streets import streets_folder
from mfvpr.evaluation import Pipeline, System
from mfvpr.features import Aggregated, AlikedFeatures, Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache

SIZES, CANDIDATES = (1000, 10_000), 50
FRAMES = 100  # of the synthetic street; a map holds each of them again and again


def measure_maps(rounds: int) -> Rows:
    """Rows of maps; each query is localized once with candidates on disk, then in rounds with candidates in memory."""
    extractors: dict[str, Any] = {"SIFT": Sift()}
    if is_installed(REGISTRY["aliked-n16"]):
        model: Any = load_model("aliked-n16")
        extractors["ALIKED n16"] = AlikedFeatures(model)
    rows: Rows = []
    with tempfile.TemporaryDirectory(prefix="mfvpr-localize-") as folder:
        root = Path(folder)
        street, cache = streets_folder(root, num_frames=FRAMES), FeatureCache(root / "cache")
        frames, queries = image_folder(street / "database").paths, image_folder(street / "queries")
        for size in SIZES:
            images = root / f"images-{size}"
            images.mkdir()
            for number in range(size):
                (images / f"{number:05d}.png").symlink_to(frames[number % FRAMES])
            for name, extractor in extractors.items():
                pipeline = Pipeline(extractor, Retrieval(Aggregated(extractor, VladFitting())), candidates=CANDIDATES)
                system = System(pipeline, {"histogram": HistogramOfShifts()})
                street_map = Map.create(root / f"{name}-{size}", images, system, cache=cache)
                rows.append({"features": name, "images": size} | _milliseconds(street_map, queries, rounds))
    return rows


def _milliseconds(street_map: Map, queries: ImageFolder, rounds: int) -> dict[str, float]:
    """With candidates in memory, with candidates that are read from disk, and of the features alone."""
    extractor = street_map.extractor
    street_map.localize(queries.paths[0])
    cold = [duration(partial(street_map.localize, path)) for path in queries.paths[1:]]
    warm = [duration(partial(street_map.localize, path)) for _ in range(rounds) for path in queries.paths]
    pixels = [resize(read_image(path), extractor.image_size, extractor.interpolation) for path in queries.paths[:20]]
    features = [duration(lambda image=image: jax.block_until_ready(extractor(image[None]))) for image in pixels]
    columns = {"p50, ms": (warm, 50), "p95, ms": (warm, 95), "p50, candidates read": (cold, 50), "p95": (cold, 95)}
    columns["features alone"] = features, 50
    return {name: 1e3 * float(np.percentile(seconds, share)) for name, (seconds, share) in columns.items()}
