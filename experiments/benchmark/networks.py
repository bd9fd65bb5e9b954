"""Networks of mfvpr, and D2-Net, MixVPR and ALIKED also in torch, with the same weights and images."""

import math
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmark.harness import Entry, ready, ready_torch, torch_or_none
from mfvpr import features
from mfvpr.checkpoints import entry_of, is_installed
from mfvpr.checkpoints.files import load
from mfvpr.checkpoints.networks import plan_network
from mfvpr.datasets import read_image, resize
from mfvpr.datasets.streets import draw_streets
from mfvpr.features.network import TOGETHER, compile_network
from mfvpr.networks.layers import preprocess

D2NET, MIXVPR, ALIKED = "d2_tf", "mixvpr_4096", "aliked-n16"


class Contest(NamedTuple):
    """A step of one network, timed in mfvpr and in torch."""

    step: str
    checkpoint: str
    size: tuple[int, int]  # (width, height) px
    extractor: Callable[..., Callable]  # takes the model, `image_size` and `batch_size`; the result takes images
    peer: str | None = None  # the network's name in `torch_networks`


def _dense_map(model: Any, image_size: tuple[int, int], batch_size: int) -> Callable[[np.ndarray], Any]:
    """D2-Net's dense map, which stays on the device, of as many images at a time as the extractors take."""
    program = compile_network(model, lambda model, batch: model(preprocess(batch, "caffe")))
    step = 1 if jax.default_backend() == "cpu" else min(batch_size, TOGETHER)
    return lambda batch: ready(lambda: [program(batch[at : at + step]) for at in range(0, len(batch), step)])()


_aliked = partial(features.AlikedFeatures, threshold=0.1)  # the paper's
_patches, _large_patches = (partial(features.PatchNetVladFeatures, patch_sizes=sizes) for sizes in ((5,), (2, 5, 8)))
PLACES, MAPILLARY = (640, 480), "patchnetvlad_mapillary"  # px of the images; checkpoints
CONTESTS = (  # features and descriptors are timed from host to host
    Contest("D2-Net dense map", D2NET, (336, 336), _dense_map, "d2net_map"),
    Contest("D2-Net features", D2NET, (336, 336), features.D2NetFeatures),
    Contest("MixVPR descriptor", MIXVPR, (320, 320), features.MixVprDescriptor, "mixvpr"),
    Contest("aliked-n16 features", ALIKED, (320, 320), _aliked, "aliked"),
    Contest("aliked-n32 features", "aliked-n32", (320, 320), _aliked, "aliked"),
    Contest("NetVLAD descriptor", f"{MAPILLARY}_512", PLACES, features.GlobalDescriptor),
    Contest("Patch-NetVLAD features, sizes 5, 512 dimensions", f"{MAPILLARY}_512", PLACES, _patches),
    Contest("Patch-NetVLAD features, sizes 2, 5, 8, 4096 dimensions", f"{MAPILLARY}_4096", PLACES, _large_patches),
    Contest("generalized mean of ResNet-50", "cosplace_resnet50_2048", PLACES, features.GlobalDescriptor),
    Contest("SelaVPR features", "selavpr_msls", (224, 224), features.SelaVprFeatures),
)
ON_ACCELERATOR = CONTESTS[:4]


def network_entries(contests: Sequence[Contest], batches: Sequence[int]) -> list[Entry]:
    """Calls of mfvpr and of torch for each size of a batch of images of the synthetic street."""
    entries = list[Entry]()
    with tempfile.TemporaryDirectory() as temporary:  # by day, at night and in snow
        street = Path(temporary) / "street"
        draw_streets(street, num_frames=math.ceil(max(batches) / 2), image_size=(336, 336))
        images = [read_image(path) for path in sorted(street.rglob("*.png"))[: max(batches)]]
    for contest in contests:
        model, arrays = make_network(contest.checkpoint)
        resized = np.stack([resize(image, contest.size) for image in images])
        for count in batches:
            extractor = contest.extractor(model, image_size=contest.size, batch_size=count)
            entries.append((f"{contest.step}, batch {count}", "mfvpr", partial(extractor, resized[:count])))
        entries += torch_entries(contest, arrays, resized, batches)
    return entries


def torch_entries(
    contest: Contest, arrays: Mapping[str, np.ndarray], images: np.ndarray, batches: Sequence[int]
) -> list[Entry]:
    """Torch, on a CPU also with channels last in memory, together and one image after the other, as in mfvpr."""
    if contest.peer is None or (torch := torch_or_none()) is None:
        return []
    from experiments.benchmark import torch_networks

    device, entries = "cpu" if jax.default_backend() == "cpu" else "cuda", list[Entry]()
    table, network = entry_of(contest.checkpoint).table, getattr(torch_networks, contest.peer)
    for title, layout in (("torch", torch.contiguous_format), ("torch, channels last", torch.channels_last)):
        weights = torch_networks.torch_weights(arrays, table, device, layout)
        run = partial(ready_torch, torch_networks.run_network, network, weights=weights, device=device, layout=layout)
        for count in batches:
            step, batch = f"{contest.step}, batch {count}", images[:count]
            entries.append((step, title, run([batch])))
            if title != "torch":
                entries.append((step, f"{title}, one by one", run(np.split(batch, count))))
        if device == "cuda":
            break
    return entries


def make_network(name: str) -> tuple[Any, dict[str, np.ndarray]]:
    """A network of mfvpr and its arrays by path: the published ones if they are installed, otherwise random."""
    entry = entry_of(name)
    plan = plan_network(entry.builder())
    arrays = load(name) if is_installed(entry) else {path: _random(path, shape) for path, shape in plan.shapes.items()}
    return plan.build(arrays), arrays


def _random(path: str, shape: tuple[int, ...]) -> np.ndarray:
    """Kernels that keep the variance through a ReLU (He et al., 2015); equal path and shape give equal numbers."""
    normal = np.random.default_rng(zlib.crc32(path.encode())).standard_normal(shape, np.float32)
    if path.endswith(".var"):
        return 1 + 0.5 * np.tanh(normal)
    if path.endswith((".bias", ".mean")):
        return 0.05 * normal
    if path.endswith(".scale"):
        return 1 + 0.1 * normal
    return normal * np.float32(math.sqrt(2 / math.prod(shape[:-1])))
