"""Milliseconds from an image file to its prediction, in maps of 1,000 and 10,000 images."""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import mfvpr
from experiments.benchmark.harness import Rows
from mfvpr.datasets import image_folder, read_image
from mfvpr.datasets.streets import streets_folder
from mfvpr.localization import Map
from mfvpr.storage import FeatureCache

SIZES = 1000, 10_000
FRAMES, IMAGE_SIZE = 100, (1024, 384)  # of the synthetic street; a map holds each of them again and again
SYSTEMS = {
    "steering features=sift": partial(mfvpr.load_system, "steering", features="sift"),
    "mfvpr": partial(mfvpr.load_system, "mfvpr"),
    "fast": partial(mfvpr.load_system, "fast"),
}


def measure_maps(rounds: int) -> Rows:
    """Rows of the systems whose weights are installed, and of map sizes."""
    rows: Rows = []
    with tempfile.TemporaryDirectory(prefix="mfvpr-localize-") as folder:
        root = Path(folder)
        street, cache = streets_folder(root, num_frames=FRAMES, image_size=IMAGE_SIZE), FeatureCache(root / "cache")
        frames, queries = image_folder(street / "database").paths, image_folder(street / "queries").paths
        for size in SIZES:
            images = root / f"images-{size}"
            images.mkdir()
            for number in range(size):
                (images / f"{number:05d}.png").symlink_to(frames[number % FRAMES])
            for name, load in SYSTEMS.items():
                try:
                    known = Map.create(root / f"{name}-{size}", images, load(), cache=cache)
                except mfvpr.InputError as error:
                    print(f"{name}: {error}")
                    continue
                rows.append({"system": name, "images": size} | _milliseconds(known, queries, rounds))
    return rows


def _milliseconds(known: Map, paths: list[Path], rounds: int) -> dict[str, float]:
    """Wall and CPU time with candidates that are read from disk and in memory, and the time of the first two steps."""
    known.warm_up()
    first = _times(known.localize, paths)
    again = np.concatenate([_times(known.localize, paths) for _ in range(rounds)])
    pixels = [read_image(path) for path in paths]
    p50, p95 = np.percentile(again, [50, 95], axis=0)
    decoding, describing = (
        np.median(times[:, 0]) for times in (_times(read_image, paths), _times(known.describing.image, pixels))
    )
    return {
        "p50, ms": p50[0],
        "p95, ms": p95[0],
        "CPU, ms": p50[1],
        "p50, candidates read": float(np.median(first[:, 0])),
        "decoding": float(decoding),
        "features and descriptors": float(describing),
    }


def _times(function: Callable[..., object], inputs: list) -> np.ndarray:
    """Milliseconds of wall and CPU time of each call."""
    times = []
    for each in inputs:
        wall, cpu = time.perf_counter(), time.process_time()
        function(each)
        times.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)))
    return np.array(times)
