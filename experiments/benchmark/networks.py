"""The networks: mfvpr's, and the same in torch, with the same weights and images."""

import math
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr.checkpoints import entry_of, is_installed
from mfvpr.checkpoints.files import load
from mfvpr.checkpoints.networks import blueprint, network_of
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
from mfvpr.features.network import compiled
from mfvpr.networks.d2net import extract
from mfvpr.networks.imagenet import preprocess

BATCHES = (1, 8)
D2NET_SIZE, MIXVPR_SIZE, ALIKED_SIZE = 336, 320, 320  # px
D2NET, MIXVPR, ALIKED = "d2_tf", "mixvpr_4096", ("aliked-n16", "aliked-n32")
MAP, ON_DEVICE, FEATURES = "D2-Net dense map", "D2-Net features, left on the device", "D2-Net features"
PLACES_SIZE, SELAVPR_SIZE = (640, 480), (224, 224)  # px: Patch-NetVLAD's, which NetVLAD and CosPlace share here
PATCHES = {"patchnetvlad_mapillary_512": (5,), "patchnetvlad_mapillary_4096": (2, 5, 8)}  # speed, performance
GEM, SELAVPR, BLOCKS = "cosplace_resnet50_2048", "selavpr_msls", 24
THRESHOLD = 0.1  # of the detection score: the paper's
PAPER = "paper, RTX 2080 Ti: features 0.03 s (D2-Net at 320), matching and score of 50 candidates 0.07 s"


def run(rounds: int | None, out: Path) -> None:
    """Everyone, on images of the drawn street."""
    compete(lineup(), rounds, out)


def lineup() -> Lineup:
    """mfvpr's networks and torch's, where it is installed."""
    images = make_images(D2NET_SIZE)
    entries = [*of_d2net(images), *of_mixvpr(_resized(images, (MIXVPR_SIZE, MIXVPR_SIZE)))]
    for name in ALIKED:
        entries += of_aliked(name, _resized(images, (ALIKED_SIZE, ALIKED_SIZE)))
    entries += of_places(images)
    width, height = PLACES_SIZE
    sizes = (f"D2-Net at {D2NET_SIZE} px, MixVPR at {MIXVPR_SIZE} px, ALIKED at {ALIKED_SIZE} px, SelaVPR at "
             f"{SELAVPR_SIZE[0]} px, others at {width} x {height} px")  # fmt: skip
    published = [name for name in (D2NET, MIXVPR, *ALIKED, *PATCHES, GEM, SELAVPR) if is_installed(entry_of(name))]
    weights = f"published weights of {', '.join(published)}, others random" if published else "random weights"
    return Lineup(
        title=f"images of the drawn street, {sizes}, {weights}",
        setting={"batches": BATCHES, "sizes": sizes, "weights": weights},
        entries=entries,
        rounds=5,
        remarks=_remarks,
    )


def _remarks(seconds: Seconds, results: Results) -> Iterator[str]:
    """The share of D2-Net's detection, and how many keypoints each side finds."""
    for count in BATCHES:
        pairs = zip(*(seconds[f"{step}, batch {count}", "mfvpr"] for step in (ON_DEVICE, MAP)), strict=True)
        share = np.median([full / dense - 1 for full, dense in pairs])
        yield f"D2-Net, batch {count}: detection adds {100 * share:.1f} % to the dense map"
    counts: dict[str, list[str]] = {}
    for (step, name), result in results.items():
        local: list[Any] = [
            one.features if isinstance(one, Description) and one.vector is None else one for one in result
        ]
        if hasattr(local[0], "keypoints"):
            mean = np.mean([len(features.keypoints) for features in local])
            counts.setdefault(step, []).append(f"{name} {mean:.1f}")
    yield from (f"{step}: keypoints per image: {'; '.join(means)}" for step, means in counts.items())
    yield PAPER


def make_images(size: int) -> np.ndarray:
    """`[max(BATCHES), size, size, 3]` uint8 RGB: a street by day, at night and in snow."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "street"
        draw_streets(folder, num_frames=math.ceil(max(BATCHES) / 2), image_size=(size, size))
        return np.stack([read_image(path) for path in sorted(folder.rglob("*.png"))[: max(BATCHES)]])


def _resized(images: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.stack([resize(image, size) for image in images])


def make_network(name: str) -> tuple[Any, dict[str, np.ndarray]]:
    """mfvpr's, and its arrays by path: the published ones where they are installed, otherwise random."""
    entry = entry_of(name)
    plan = blueprint(entry)
    arrays = load(name) if is_installed(entry) else {path: _random(path, shape) for path, shape in plan.shapes.items()}
    return plan.filled(arrays), arrays


def _random(path: str, shape: tuple[int, ...]) -> np.ndarray:
    """Kernels keep the variance through a ReLU (He et al., 2015); depends on path and shape alone."""
    normal = np.random.default_rng(zlib.crc32(path.encode())).standard_normal(shape, np.float32)
    if path.endswith(".var"):
        return 1 + 0.5 * np.tanh(normal)
    if path.endswith((".bias", ".mean")):
        return 0.05 * normal
    if path.endswith(".scale"):
        return 1 + 0.1 * normal
    return normal * np.float32(math.sqrt(2 / math.prod(shape[:-1])))


def of_d2net(images: np.ndarray) -> list[Entry]:
    """The dense map, and keypoints from host to host; of mfvpr also those that stay on the device."""
    model, arrays = make_network(D2NET)
    dense = compiled(model, lambda model, batch: model(preprocess(batch, "caffe")))
    on_device = compiled(model, partial(extract, share=0.3))
    extractor = partial(D2NetFeatures, model, image_size=images.shape[2:0:-1])
    steps = {
        MAP: lambda _: partial(_on_device, dense),
        ON_DEVICE: lambda _: partial(_on_device, on_device),
        FEATURES: lambda count: extractor(batch_size=count),
    }
    entries = of_mfvpr(steps, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_networks import d2net, d2net_map

        entries += of_torch({MAP: d2net_map, FEATURES: d2net}, D2NET, arrays, images)
    return entries


def of_mixvpr(images: np.ndarray) -> list[Entry]:
    """Descriptors on the host."""
    model, arrays = make_network(MIXVPR)
    step = "MixVPR descriptor"
    entries = of_mfvpr({step: lambda count: MixVprDescriptor(model, batch_size=count)}, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_networks import mixvpr

        entries += of_torch({step: mixvpr}, MIXVPR, arrays, images)
    return entries


def of_aliked(name: str, images: np.ndarray) -> list[Entry]:
    """Keypoints from host to host."""
    model, arrays = make_network(name)
    step = f"{name} features"
    extractor = partial(AlikedFeatures, model, image_size=images.shape[2:0:-1], threshold=THRESHOLD)
    entries = of_mfvpr({step: lambda count: extractor(batch_size=count)}, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_aliked import aliked

        note = " (deformable convolution in Python)"
        entries += of_torch({step: partial(aliked, threshold=THRESHOLD)}, name, arrays, images, note)
    return entries


def of_places(images: np.ndarray) -> list[Entry]:
    """NetVLAD, its patches, a generalized mean, and SelaVPR, from host to host."""
    large, small = _resized(images, PLACES_SIZE), _resized(images, SELAVPR_SIZE)
    speed, performance = PATCHES
    lineup = [
        ("NetVLAD descriptor", speed, large, "netvlad", {}, GlobalDescriptor),
        *((f"Patch-NetVLAD features, {_sizes(name)}", name, large, "patch_netvlad", {"sizes": PATCHES[name]},
           partial(PatchNetVladFeatures, patch_sizes=PATCHES[name])) for name in (speed, performance)),
        ("generalized mean of ResNet-50", GEM, large, "gem", {}, GlobalDescriptor),
        ("SelaVPR features", SELAVPR, small, "selavpr", {"blocks": BLOCKS}, SelaVprFeatures),
    ]  # fmt: skip
    entries = []
    for step, name, batch, peer, options, extractor in lineup:
        model, arrays = make_network(name)
        made = partial(extractor, model, image_size=batch.shape[2:0:-1])
        entries += of_mfvpr({step: lambda count, made=made: made(batch_size=count)}, batch)
        if find_spec("torch"):
            from experiments.benchmark import torch_places

            network = partial(getattr(torch_places, peer), **options)
            entries += of_torch({step: network}, name, arrays, batch)
    return entries


def _sizes(name: str) -> str:
    return f"sizes {', '.join(map(str, PATCHES[name]))}, {name.rpartition('_')[2]} dimensions"


def of_mfvpr(steps: Mapping[str, Callable[[int], Callable]], images: np.ndarray) -> list[Entry]:
    """Each step of every batch; a step is given the batch's size, and returns what takes such a batch."""
    return [
        (f"{step}, batch {count}", "mfvpr", partial(make(count), images[:count]))
        for count in BATCHES
        for step, make in steps.items()
    ]


def _on_device(program: Callable[[Any], Any], batch: np.ndarray) -> Any:
    """One by one on a CPU, as the extractors do it."""
    size = 1 if jax.default_backend() == "cpu" else len(batch)
    return jax.block_until_ready([program(batch[start : start + size]) for start in range(0, len(batch), size)])


def of_torch(
    steps: Mapping[str, Callable], name: str, arrays: Mapping[str, np.ndarray], images: np.ndarray, note: str = ""
) -> list[Entry]:
    """In both memory layouts; on a CPU one by one as well, as mfvpr does it. As precise as mfvpr on a GPU."""
    import torch

    from experiments.benchmark.torch_networks import each, published

    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    device, table = "cuda" if torch.cuda.is_available() else "cpu", network_of(entry_of(name)).table
    default, channels_last = (
        partial(each, weights=published(arrays, table, device, layout), device=device, layout=layout)
        for layout in (torch.contiguous_format, torch.channels_last)
    )
    entries: list[Entry] = []
    for step, network in steps.items():
        for count in BATCHES:
            batch, where = images[:count], f"{step}, batch {count}"
            entries.append((where, f"torch{note}", partial(default, network, [batch])))
            entries.append((where, f"torch, channels last{note}", partial(channels_last, network, [batch])))
            if count > 1 and device == "cpu":
                one_by_one = partial(channels_last, network, np.split(batch, count))
                entries.append((where, f"torch, channels last, one by one{note}", one_by_one))
    return entries
