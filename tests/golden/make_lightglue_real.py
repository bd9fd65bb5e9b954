"""Makes lightglue_real.npz: ALIKED's features of photographs, and what the public code matches.

    python -m tests.golden lightglue_real CLONE WEIGHTS DATA

CLONE is a clone of https://github.com/cvg/LightGlue, WEIGHTS the published ones for ALIKED, DATA a folder that has
grief_season and corridor; aliked-n16 is installed. The file has features, no image. The matcher runs in float64
without pruning.
"""

from pathlib import Path

import numpy as np

from experiments.paper.systems import REAL
from mfvpr.checkpoints import load_model
from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.core.types import Features
from mfvpr.datasets import read_image, resize
from mfvpr.features import AlikedFeatures
from tests.golden.make_lightglue import as_tensors, public

SIZE, KEYPOINTS = (336, 336), 160
QUERIES = (20, 70)  # of each place, with their own database images
PAIRS = [f"{place}/{query}" for place in REAL for query in QUERIES]


def features(golden: dict[str, np.ndarray], pair: str) -> list[Features]:
    """Features of both images."""
    images = []
    for side in "01":
        keypoints, descriptors = (golden[f"{pair}/{name}{side}"] for name in ("keypoints", "descriptors"))
        ones = np.ones(len(keypoints), np.float32)
        size = np.array(SIZE, np.float32)
        images.append(Features(keypoints, descriptors.astype(np.float32), ones, ones.astype(bool), size))
    return images


def main(clone: str, weights: str, data: str) -> dict[str, np.ndarray]:
    extractor = AlikedFeatures(load_model("aliked-n16"), image_size=SIZE, max_keypoints=KEYPOINTS)  # pyright: ignore[reportArgumentType]
    network, golden = public(clone, read_checkpoint(Path(weights))), {}
    for pair in PAIRS:
        place, query = pair.split("/")
        for side, folder in zip("01", reversed(REAL[place]), strict=True):
            paths = sorted((Path(data) / place / folder).iterdir(), key=lambda path: (len(path.name), path.name))
            [described] = extractor(resize(read_image(paths[int(query)]), SIZE)[None])
            real = np.asarray(described.features.mask)
            golden[f"{pair}/keypoints{side}"] = np.asarray(described.features.keypoints)[real]
            golden[f"{pair}/descriptors{side}"] = np.asarray(described.features.descriptors)[real].astype(np.float16)
        matched = as_tensors(features(golden, pair))
        result = network({"image0": matched[0], "image1": matched[1]})
        golden[f"{pair}/matches"] = result["matches"][0].numpy().astype(np.int32)
        golden[f"{pair}/scores"] = result["scores"][0].numpy().astype(np.float32)
    return golden
