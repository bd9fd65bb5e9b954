"""Makes lightglue.npz: what the public code computes. `python -m tests.golden lightglue CLONE WEIGHTS`

CLONE is a clone of https://github.com/cvg/LightGlue, whose matcher is run in float64 without pruning: small networks of
random weights, and the published ones for ALIKED, WEIGHTS.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.core.types import Features
from tests.builders import make_features
from tests.random_checkpoints import lightglue_shapes, random_checkpoint

SMALL = {"inputs": 16, "width": 32, "layers": 3, "heads": 2}
IMAGES = np.array([[320, 240], [200, 360]], np.float32)  # px, of both sides
SIZES = ((24, 31), (17, 5), (1, 9), (1, 1))  # keypoints of both images
SEEDS = (0, 1)
DEPTH = 0.95  # the published share of sure keypoints
SURE = (None, 0, 1)  # after which layer the keypoints of small networks are made sure; None = never
REAL = ((60, 48), (33, 70))


def checkpoint(seed: int, sure: int | None = None) -> dict[str, np.ndarray]:
    """Random weights of a small network, whose keypoints all are sure after a layer."""
    tensors = random_checkpoint(lightglue_shapes(**SMALL), seed)
    if sure is not None:
        tensors[f"token_confidence.{sure}.token.0.bias"] += np.float32(9)
    return tensors


def pair(counts: tuple[int, int], inputs: int, seed: int) -> tuple[Features, Features]:
    """Two images of made-up features; a part of the second's are those of the first, moved and disturbed."""
    rng = np.random.default_rng([seed, *counts])
    first, second = (
        replace(make_features(rng, count, dimension=inputs, size=200), image_size=size)
        for count, size in zip(counts, IMAGES, strict=True)
    )
    common = min(counts) // 2 + 1
    second.keypoints[:common] = first.keypoints[:common] + 20
    disturbed = first.descriptors[:common] + 0.03 * rng.normal(size=(common, inputs))
    second.descriptors[:common] = disturbed / np.linalg.norm(disturbed, axis=1, keepdims=True)
    return first, second


def main(clone: str, weights: str) -> dict[str, np.ndarray]:
    golden = {}
    for seed in SEEDS:
        for counts in SIZES:
            features = pair(counts, SMALL["inputs"], seed)
            golden[f"random/{seed}/{counts}"], _ = _computed(clone, checkpoint(seed), features)
    for sure in SURE:
        features = pair(SIZES[0], SMALL["inputs"], 0)
        golden[f"sure/{sure}"], stop = _computed(clone, checkpoint(0, sure), features, depth_confidence=DEPTH)
        assert stop == (SMALL["layers"] if sure is None else sure + 1)
    real = read_checkpoint(Path(weights))
    for counts in REAL:
        golden[f"real/{counts}"] = _computed(clone, real, pair(counts, 128, 0))[0].astype(np.float32)
    return golden


def _computed(clone, tensors, features, **options) -> tuple[np.ndarray, int]:
    """The logarithm of the assignment `[N0, N1]`, and after how many layers."""
    import torch

    network, read = public(clone, tensors, **options), []
    for head in network.log_assignment:
        head.register_forward_hook(lambda _, __, result: read.append(result[0]))
    sides = as_tensors(features)
    with torch.inference_mode():
        result = network({"image0": sides[0], "image1": sides[1]})
    [scores] = read
    return scores[0, :-1, :-1].numpy(), result["stop"]


def public(clone, tensors, **options):
    """The public matcher with some weights, in float64."""
    import torch

    sys.path.insert(0, f"{clone}/lightglue")  # one file: the package asks for the libraries of all extractors
    from lightglue import LightGlue

    layers = sum(key.startswith("log_assignment") and key.endswith("matchability.bias") for key in tensors)
    width, inputs = tensors["input_proj.weight"].shape
    heads = width // (2 * len(tensors["posenc.Wr.weight"]))
    options = {"depth_confidence": -1, "width_confidence": -1} | options
    network = LightGlue(None, input_dim=inputs, descriptor_dim=width, n_layers=layers, num_heads=heads, **options)
    network.load_state_dict({key: torch.tensor(array) for key, array in tensors.items()}, strict=False)
    return network.double().eval().requires_grad_(False)


def as_tensors(features):
    """Inputs of the public matcher for each image."""
    import torch

    sides = [{name: getattr(image, name) for name in ("keypoints", "descriptors", "image_size")} for image in features]
    return [{name: torch.tensor(array)[None].double() for name, array in side.items()} for side in sides]
