"""Networks of mfvpr and the same networks in torch, with the same weights and images."""

import math
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmark.harness import Entry, Results, Seconds, compete
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
D2NET_SIZE, MIXVPR_SIZE, ALIKED_SIZE = 336, 320, 320  # px
D2NET, MIXVPR, ALIKED = "d2_tf", "mixvpr_4096", ("aliked-n16", "aliked-n32")
MAP, ON_DEVICE, FEATURES = "D2-Net dense map", "D2-Net features, left on the device", "D2-Net features"
PLACES_SIZE, SELAVPR_SIZE = (640, 480), (224, 224)  # px; NetVLAD and CosPlace take Patch-NetVLAD's size here
PATCHES = {"patchnetvlad_mapillary_512": (5,), "patchnetvlad_mapillary_4096": (2, 5, 8)}  # speed, performance
GEM, SELAVPR, BLOCKS = "cosplace_resnet50_2048", "selavpr_msls", 24
THRESHOLD = 0.1  # of ALIKED's detection score, the paper's
PAPER = "paper, RTX 2080 Ti: features 0.03 s (D2-Net at 320), matching and score of 50 candidates 0.07 s"


class Contest(NamedTuple):
    """A step of one network, timed in mfvpr and in torch."""

    step: str
    checkpoint: str
    size: tuple[int, int]  # (width, height) px
    extractor: Callable[..., Callable]  # takes the model and `batch_size`; the result takes a batch of images
    peer: str | None  # function of `torch_networks`
    options: dict[str, Any] | None = None  # keyword arguments of torch's function
    note: str = ""


def run(rounds: int | None, out: Path) -> Results:
    """Time all networks of mfvpr, and of torch where it is installed, on images of the synthetic street."""
    images = make_images(D2NET_SIZE)
    entries: list[Entry] = []
    for contest in contests():
        model, arrays = make_network(contest.checkpoint)
        batch = np.stack([resize(image, contest.size) for image in images])
        for count in BATCHES:
            extractor = contest.extractor(model, batch_size=count)
            entries.append((f"{contest.step}, batch {count}", "mfvpr", partial(extractor, batch[:count])))
        if contest.peer and find_spec("torch"):
            entries += torch_entries(contest, arrays, batch, BATCHES)
    sides = {"D2-Net": D2NET_SIZE, "MixVPR": MIXVPR_SIZE, "ALIKED": ALIKED_SIZE, "SelaVPR": SELAVPR_SIZE[0]}
    sizes = ", ".join(f"{name} at {side} px" for name, side in sides.items())
    sizes += f", others at {PLACES_SIZE[0]} x {PLACES_SIZE[1]} px"
    published = [name for name in (D2NET, MIXVPR, *ALIKED, *PATCHES, GEM, SELAVPR) if is_installed(entry_of(name))]
    weights = f"published weights of {', '.join(published)}, others random" if published else "random weights"
    title = f"images of the synthetic street, {sizes}, {weights}"
    setting = {"batches": BATCHES, "sizes": sizes, "weights": weights}
    return compete(entries, rounds or 5, out, title=title, setting=setting, remarks=_remarks)


def contests() -> Iterator[Contest]:
    """All steps; features and descriptors are timed from host to host."""
    size = (D2NET_SIZE, D2NET_SIZE)
    dense = partial(_program, lambda model, batch: model(preprocess(batch, "caffe")))
    yield Contest(MAP, D2NET, size, dense, "d2net_map")
    yield Contest(ON_DEVICE, D2NET, size, partial(_program, partial(extract, share=0.3)), None)
    yield Contest(FEATURES, D2NET, size, partial(D2NetFeatures, image_size=size), "d2net")
    size = (MIXVPR_SIZE, MIXVPR_SIZE)
    yield Contest("MixVPR descriptor", MIXVPR, size, MixVprDescriptor, "mixvpr")
    size = (ALIKED_SIZE, ALIKED_SIZE)
    for name in ALIKED:
        extractor = partial(AlikedFeatures, image_size=size, threshold=THRESHOLD)
        note = " (deformable convolution in Python)"
        yield Contest(f"{name} features", name, size, extractor, "aliked", {"threshold": THRESHOLD}, note)
    vector = partial(GlobalDescriptor, image_size=PLACES_SIZE)
    yield Contest("NetVLAD descriptor", next(iter(PATCHES)), PLACES_SIZE, vector, "netvlad")
    for name, sizes in PATCHES.items():
        step = f"Patch-NetVLAD features, sizes {', '.join(map(str, sizes))}, {name.rpartition('_')[2]} dimensions"
        extractor = partial(PatchNetVladFeatures, patch_sizes=sizes, image_size=PLACES_SIZE)
        yield Contest(step, name, PLACES_SIZE, extractor, "patch_netvlad", {"sizes": sizes})
    yield Contest("generalized mean of ResNet-50", GEM, PLACES_SIZE, vector, "gem")
    extractor = partial(SelaVprFeatures, image_size=SELAVPR_SIZE)
    yield Contest("SelaVPR features", SELAVPR, SELAVPR_SIZE, extractor, "selavpr", {"blocks": BLOCKS})


def _program(function: Callable[[Any, Any], Any], model: Any, batch_size: int) -> Callable[[np.ndarray], Any]:
    """Run a compiled function whose results stay on the device, on as many images at a time as the extractors do."""
    program = compile_network(model, function)
    step = 1 if jax.default_backend() == "cpu" else min(batch_size, TOGETHER)
    return lambda batch: jax.block_until_ready(
        [program(batch[start : start + step]) for start in range(0, len(batch), step)]
    )


def _remarks(seconds: Seconds, results: Results) -> Iterator[str]:
    for count in BATCHES:
        pairs = zip(*(seconds[f"{step}, batch {count}", "mfvpr"] for step in (ON_DEVICE, MAP)), strict=True)
        share = np.median([full / dense - 1 for full, dense in pairs])
        yield f"D2-Net, batch {count}: detection adds {100 * share:.1f} % to the dense map"
    counts: dict[str, list[str]] = {}
    for (step, name), result in results.items():
        local: list[Any] = [
            image.features if isinstance(image, Description) and image.vector is None else image for image in result
        ]
        if hasattr(local[0], "keypoints"):
            mean = np.mean([len(features.keypoints) for features in local])
            counts.setdefault(step, []).append(f"{name} {mean:.1f}")
    yield from (f"{step}: keypoints per image: {'; '.join(means)}" for step, means in counts.items())
    yield PAPER


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


def torch_entries(
    contest: Contest, arrays: Mapping[str, np.ndarray], images: np.ndarray, batches: tuple[int, ...]
) -> list[Entry]:
    """Torch in both memory layouts, in float32 on a GPU; on a CPU also one image after the other, as in mfvpr."""
    import torch

    from experiments.benchmark import torch_networks

    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    network = partial(getattr(torch_networks, str(contest.peer)), **(contest.options or {}))
    device, table = "cuda" if torch.cuda.is_available() else "cpu", NETWORKS[contest.checkpoint].table

    def run_with(layout: torch.memory_format) -> Callable[[list[np.ndarray]], list[Any]]:
        weights = torch_networks.torch_weights(arrays, table, device, layout)
        return partial(torch_networks.run_network, network, weights=weights, device=device, layout=layout)

    default, channels_last = run_with(torch.contiguous_format), run_with(torch.channels_last)
    entries: list[Entry] = []
    for count in batches:
        batch, step = images[:count], f"{contest.step}, batch {count}"
        entries.append((step, f"torch{contest.note}", partial(default, [batch])))
        entries.append((step, f"torch, channels last{contest.note}", partial(channels_last, [batch])))
        if count > 1 and device == "cpu":
            split = partial(channels_last, np.split(batch, count))
            entries.append((step, f"torch, channels last, one by one{contest.note}", split))
    return entries
