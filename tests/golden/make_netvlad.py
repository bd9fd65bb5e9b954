"""Makes netvlad.npz: global descriptors and patches of public codes with random weights, in float64.

`python -m tests.golden netvlad PATCHNETVLAD HLOC COSPLACE` with torchvision and clones of
https://github.com/QVPR/Patch-NetVLAD, https://github.com/cvg/Hierarchical-Localization and
https://github.com/gmberton/CosPlace.
"""

import importlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.golden.torch_networks import fill, replace_module
from tests.random_checkpoints import gem_shapes, matlab_netvlad, netvlad_shapes, random_checkpoint, write_matlab

SAMPLES = 1000
PATCHES = {4096: (2, 5, 8), 512: (5,), 128: (5,)}  # sizes in the three published configurations, by their outputs
# Of Patch-NetVLAD's networks: clusters, outputs, image size, seed. The first is the quickest.
CASES = ((64, 128, (171, 203), 5), (64, None, (171, 203), 6), (16, 512, (171, 203), 4), (16, 4096, (640, 480), 0))
MATLAB = (64, 128, (171, 203), 7)  # outputs of the original are 4096; fewer are as good a test
POSITIONS = (((171, 203), 3), ((640, 480), 2), ((640, 480), 5), ((640, 480), 8))  # image and patch sizes
GEM = (("vgg16", 512, (171, 203), 8), ("resnet50", 512, (171, 203), 9), ("resnet50", 2048, (128, 96), 10))


def image(size: tuple[int, int]) -> np.ndarray:
    """`[1, H, W, 3]` uint8: stripes, circles and steps, by integer arithmetic alone."""
    row, column, channel = np.indices((*size[::-1], 3))
    circles = (row - 90) ** 2 + (column - 120) ** 2
    values = circles // (150 + 60 * channel) + 40 * ((row // 32 + column // 24) % 3) + row * column // (90 + channel)
    return (values % 256).astype(np.uint8)[None]


def samples(values: np.ndarray) -> np.ndarray:
    """Values at `SAMPLES` places, or all."""
    flat = values.reshape(-1)
    return flat if flat.size <= SAMPLES else flat[np.random.default_rng(0).choice(flat.size, SAMPLES, replace=False)]


def name(*case: Any) -> str:
    """Name of a case in the file."""
    return "/".join(map(str, case))


def main(_: str, hloc: str, __: str) -> dict[str, np.ndarray]:
    import torch
    from torchvision import models

    for name_of_network in ("vgg16", "resnet50"):  # without their training
        maker = getattr(models, name_of_network)
        setattr(models, name_of_network, lambda maker=maker, **_: maker())
    replace_module("sklearn", neighbors=replace_module("sklearn.neighbors", NearestNeighbors=None))  # for training
    with torch.inference_mode():
        golden = dict(_patches()) | dict(_positions())
        golden[name("matlab", *MATLAB)] = _matlab(hloc)
        golden |= {name("gem", *case): _gem(*case) for case in GEM}
    return {key: array.astype(np.float32) for key, array in golden.items()}


def normalized(size: tuple[int, int]) -> Any:
    """As ToTensor and Normalize do, in float64."""
    import torch

    from mfvpr.networks.layers import DEVIATION, MEAN

    pixels = torch.from_numpy(image(size)).permute(0, 3, 1, 2).double() / 255
    mean, deviation = (torch.tensor(values, dtype=torch.float64)[None, :, None, None] for values in (MEAN, DEVIATION))
    return (pixels - mean) / deviation


def _patches() -> Iterator[tuple[str, np.ndarray]]:
    """As Patch-NetVLAD's feature_extract.py, its global descriptor and all patches; without a projection NetVLAD's."""
    from configparser import ConfigParser

    import torch
    from patchnetvlad.models.models_generic import get_backend, get_model, get_pca_encoding

    for clusters, outputs, size, seed in CASES:
        config = ConfigParser()
        config["global_params"] = {
            "pooling": "patchnetvlad" if outputs else "netvlad",
            "num_clusters": str(clusters),
            "vladv2": "False",
            "num_pcs": str(outputs),
            "patch_sizes": ",".join(map(str, PATCHES.get(outputs or 0, (1,)))),
            "strides": ",".join("1" for _ in PATCHES.get(outputs or 0, (1,))),
        }
        channels, encoder = get_backend()
        model = get_model(encoder, channels, config["global_params"], append_pca_layer=outputs is not None)
        fill(model, random_checkpoint(netvlad_shapes(clusters, outputs), seed)).double()
        torch.set_default_dtype(torch.float64)
        encoded = model.pool(model.encoder(normalized(size)))  # pyright: ignore
        torch.set_default_dtype(torch.float32)
        case = name("patch", clusters, outputs, size, seed)
        if outputs is None:
            yield f"{case}/global", samples(encoded.numpy())
            continue
        local, descriptor = encoded
        yield f"{case}/global", get_pca_encoding(model, descriptor).numpy()[0]
        for patch, descriptors in zip(PATCHES[outputs], local, strict=True):
            _, inputs, count = descriptors.shape
            rows = descriptors.permute(2, 0, 1).reshape(-1, inputs)
            projected = get_pca_encoding(model, rows).reshape(count, outputs).numpy()
            yield f"{case}/{patch}", samples(projected)
            yield f"{case}/{patch}/means", projected.mean(axis=0)


def _positions() -> Iterator[tuple[str, np.ndarray]]:
    """Keypoints `[n, 2]` (x, y) of all patches."""
    from patchnetvlad.models.local_matcher import calc_keypoint_centers_from_patches

    for (width, height), patch in POSITIONS:
        config = {"imageresizeW": width, "imageresizeH": height}
        keypoints, _ = calc_keypoint_centers_from_patches(config, patch, patch, 1, 1)
        yield name("positions", (width, height), patch), keypoints.T


def _matlab(clone: str) -> np.ndarray:
    """As hloc's extractor, of a file as the original's."""
    import torch

    for package in ("hloc", "hloc.extractors", "hloc.utils"):  # without what it imports besides
        replace_module(package, __path__=[f"{clone}/{package.replace('.', '/')}"])
    extractor = importlib.import_module("hloc.extractors.netvlad")
    clusters, outputs, size, seed = MATLAB
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode(False):
        torch.hub.set_dir(folder)
        path = Path(folder) / "netvlad" / "VGG16-NetVLAD-Pitts30K.mat"
        path.parent.mkdir()
        write_matlab(path, matlab_netvlad(clusters, outputs, seed))
        model = extractor.NetVLAD({"model_name": "VGG16-NetVLAD-Pitts30K", "whiten": True}).double().eval()
    pixels = torch.from_numpy(image(size)).permute(0, 3, 1, 2).double() / 255
    return model({"image": pixels})["global_descriptor"].numpy()[0]


def _gem(backbone: str, outputs: int, size: tuple[int, int], seed: int) -> np.ndarray:
    """As CosPlace's network."""
    from cosplace_model.cosplace_network import GeoLocalizationNet

    public = {"vgg16": "VGG16", "resnet50": "ResNet50"}[backbone]
    model = fill(GeoLocalizationNet(public, outputs), random_checkpoint(gem_shapes(backbone, outputs), seed))
    return model.double()(normalized(size)).numpy()[0]
