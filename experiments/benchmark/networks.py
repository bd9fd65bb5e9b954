"""Networks of mfvpr, and D2-Net, MixVPR and ALIKED also in torch, with the same weights and images."""

import math
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmark.harness import Entry, Results, compete
from mfvpr.checkpoints import entry_of, is_installed
from mfvpr.checkpoints.files import load
from mfvpr.checkpoints.networks import NETWORKS, blueprint
from mfvpr.datasets import read_image, resize
from mfvpr.datasets.streets import draw_streets
from mfvpr.features import (
    AlikedFeatures,
    D2NetFeatures,
    Description,
    GlobalDescriptor,
    MixVprDescriptor,
    PatchNetVladFeatures,
    SelaVprFeatures,
)
from mfvpr.features.network import TOGETHER, compile_network
from mfvpr.networks.d2net import extract
from mfvpr.networks.layers import preprocess

BATCHES = (1, 8)
D2NET_SIZE, MIXVPR_SIZE, ALIKED_SIZE = (336, 336), (320, 320), (320, 320)  # (width, height) px
D2NET, MIXVPR, ALIKED = "d2_tf", "mixvpr_4096", ("aliked-n16", "aliked-n32")
MAP, ON_DEVICE, FEATURES = "D2-Net dense map", "D2-Net features, left on the device", "D2-Net features"
PLACES_SIZE, SELAVPR_SIZE = (640, 480), (224, 224)  # px; NetVLAD and CosPlace take Patch-NetVLAD's size here
PATCHES = {"patchnetvlad_mapillary_512": (5,), "patchnetvlad_mapillary_4096": (2, 5, 8)}  # speed, performance
GEM, SELAVPR = "cosplace_resnet50_2048", "selavpr_msls"
THRESHOLD = 0.1  # of ALIKED's detection score, the paper's


class Contest(NamedTuple):
    """A step of one network, timed in mfvpr and in torch."""

    step: str
    checkpoint: str
    size: tuple[int, int]  # (width, height) px
    extractor: Callable[..., Callable]  # takes the model and `batch_size`; the result takes a batch of images
    peer: Callable[[Any], Callable] | None = None  # the network of the module `torch_networks`


def run(rounds: int | None, out: Path) -> Results:
    """Time all networks of mfvpr, and of torch where it is installed, on images of the synthetic street."""
    images = make_images(D2NET_SIZE[0])
    entries = [entry for contest in contests() for entry in contest_entries(contest, images, BATCHES)]
    published = [name for name in {contest.checkpoint for contest in contests()} if is_installed(entry_of(name))]
    title = (
        f"images of the synthetic street, published weights of {', '.join(sorted(published)) or 'none'}, others random"
    )
    return compete(entries, rounds or 5, out, title=title, remarks=_remarks)


def contests() -> Iterator[Contest]:
    """All steps; features and descriptors are timed from host to host."""
    dense = partial(_program, lambda model, batch: model(preprocess(batch, "caffe")))
    yield Contest(MAP, D2NET, D2NET_SIZE, dense, lambda peers: peers.d2net_map)
    yield Contest(ON_DEVICE, D2NET, D2NET_SIZE, partial(_program, partial(extract, share=0.3)))
    extractor = partial(D2NetFeatures, image_size=D2NET_SIZE)
    yield Contest(FEATURES, D2NET, D2NET_SIZE, extractor, lambda peers: peers.d2net)
    yield Contest("MixVPR descriptor", MIXVPR, MIXVPR_SIZE, MixVprDescriptor, lambda peers: peers.mixvpr)
    for name in ALIKED:
        extractor = partial(AlikedFeatures, image_size=ALIKED_SIZE, threshold=THRESHOLD)
        peer = lambda peers: partial(peers.aliked, threshold=THRESHOLD)  # noqa: E731
        yield Contest(f"{name} features", name, ALIKED_SIZE, extractor, peer)
    vector = partial(GlobalDescriptor, image_size=PLACES_SIZE)
    yield Contest("NetVLAD descriptor", next(iter(PATCHES)), PLACES_SIZE, vector)
    for name, sizes in PATCHES.items():
        step = f"Patch-NetVLAD features, sizes {', '.join(map(str, sizes))}, {name.rpartition('_')[2]} dimensions"
        extractor = partial(PatchNetVladFeatures, patch_sizes=sizes, image_size=PLACES_SIZE)
        yield Contest(step, name, PLACES_SIZE, extractor)
    yield Contest("generalized mean of ResNet-50", GEM, PLACES_SIZE, vector)
    yield Contest("SelaVPR features", SELAVPR, SELAVPR_SIZE, partial(SelaVprFeatures, image_size=SELAVPR_SIZE))


def contest_entries(contest: Contest, images: np.ndarray, batches: tuple[int, ...]) -> list[Entry]:
    """Calls of mfvpr and of torch for each size of a batch."""
    model, arrays = make_network(contest.checkpoint)
    batch = np.stack([resize(image, contest.size) for image in images])
    entries: list[Entry] = []
    for count in batches:
        extractor = contest.extractor(model, batch_size=count)
        entries.append((f"{contest.step}, batch {count}", "mfvpr", partial(extractor, batch[:count])))
    return entries + torch_entries(contest, arrays, batch, batches)


def _program(function: Callable[[Any, Any], Any], model: Any, batch_size: int) -> Callable[[np.ndarray], Any]:
    """Run a compiled function whose results stay on the device, on as many images at a time as the extractors do."""
    program = compile_network(model, function)
    step = 1 if jax.default_backend() == "cpu" else min(batch_size, TOGETHER)
    return lambda batch: jax.block_until_ready(
        [program(batch[start : start + step]) for start in range(0, len(batch), step)]
    )


def torch_entries(
    contest: Contest, arrays: Mapping[str, np.ndarray], images: np.ndarray, batches: tuple[int, ...]
) -> list[Entry]:
    """Torch, on a CPU also with channels last in memory, together and one image after the other, as in mfvpr."""
    if contest.peer is None or not find_spec("torch"):
        return []
    import torch

    from experiments.benchmark import torch_networks

    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    on_gpu, table = torch.cuda.is_available(), NETWORKS[contest.checkpoint].table
    network = contest.peer(torch_networks)

    def run_with(layout: torch.memory_format) -> Callable[[list[np.ndarray]], list[Any]]:
        device = "cuda" if on_gpu else "cpu"
        weights = torch_networks.torch_weights(arrays, table, device, layout)
        return partial(torch_networks.run_network, network, weights=weights, device=device, layout=layout)

    default, channels_last = run_with(torch.contiguous_format), run_with(torch.channels_last)
    entries: list[Entry] = []
    for count in batches:
        batch, step = images[:count], f"{contest.step}, batch {count}"
        entries.append((step, "torch", partial(default, [batch])))
        if not on_gpu:
            entries.append((step, "torch, channels last", partial(channels_last, [batch])))
            one_by_one = partial(channels_last, np.split(batch, count))
            entries.append((step, "torch, channels last, one by one", one_by_one))
    return entries


def _remarks(results: Results) -> Iterable[str]:
    counts: dict[str, list[str]] = {}
    for (step, name), result in results.items():
        if step.startswith((FEATURES, *ALIKED)) and ON_DEVICE not in step:
            features = [image.features if isinstance(image, Description) else image for image in result]
            mean = np.mean([len(image.keypoints) for image in features])
            counts.setdefault(step, []).append(f"{name} {mean:.1f}")
    return [f"{step}: keypoints per image: {'; '.join(means)}" for step, means in counts.items()]


def make_images(size: int) -> np.ndarray:
    """RGB images `[max(BATCHES), size, size, 3]` uint8 of the synthetic street by day, at night and in snow."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "street"
        draw_streets(folder, num_frames=math.ceil(max(BATCHES) / 2), image_size=(size, size))
        return np.stack([read_image(path) for path in sorted(folder.rglob("*.png"))[: max(BATCHES)]])


def make_network(name: str) -> tuple[Any, dict[str, np.ndarray]]:
    """A network of mfvpr and its arrays by path: the published ones if they are installed, otherwise random."""
    entry = entry_of(name)
    plan = blueprint(entry)
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
