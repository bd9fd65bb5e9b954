"""The networks: mfvpr's, and the same in torch, with the same weights and images."""

import math
import re
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr.data.images import read_image, resize
from mfvpr.data.streets import draw_streets
from mfvpr.features.aliked import AlikedFeatures
from mfvpr.features.d2net import D2NetFeatures
from mfvpr.features.mixvpr import MixVprDescriptor
from mfvpr.features.network import compiled
from mfvpr.models.d2net import extract, preprocess
from mfvpr.weights.files import is_installed, load
from mfvpr.weights.networks import blueprint, network_of
from mfvpr.weights.registry import entry_of

if TYPE_CHECKING:
    import torch

BATCHES = (1, 8)
D2NET_SIZE, MIXVPR_SIZE, ALIKED_SIZE = 336, 320, 320  # px
D2NET, MIXVPR, ALIKED = "d2_tf", "mixvpr_4096", ("aliked-n16", "aliked-n32")
MAP, ON_DEVICE, FEATURES = "D2-Net dense map", "D2-Net features, left on the device", "D2-Net features"
THRESHOLD = 0.1  # of the detection score: the paper's
PAPER = "paper, RTX 2080 Ti: features 0.03 s (D2-Net at 320), matching and score of 50 candidates 0.07 s"


def run(rounds: int | None, out: Path) -> None:
    """Everyone, on images of the drawn street."""
    compete(lineup(), rounds, out)


def lineup() -> Lineup:
    """mfvpr's networks and torch's, where it is installed."""
    images = make_images(D2NET_SIZE)
    entries = [*of_d2net(images), *of_mixvpr(_resized(images, MIXVPR_SIZE))]
    for name in ALIKED:
        entries += of_aliked(name, _resized(images, ALIKED_SIZE))
    sizes = f"D2-Net at {D2NET_SIZE} px, MixVPR at {MIXVPR_SIZE} px, ALIKED at {ALIKED_SIZE} px"
    published = [name for name in (D2NET, MIXVPR, *ALIKED) if is_installed(entry_of(name))]
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
        if hasattr(result[0], "keypoints"):
            mean = np.mean([len(features.keypoints) for features in result])
            counts.setdefault(step, []).append(f"{name} {mean:.1f}")
    yield from (f"{step}: keypoints per image: {'; '.join(means)}" for step, means in counts.items())
    yield PAPER


def make_images(size: int) -> np.ndarray:
    """`[max(BATCHES), size, size, 3]` uint8 RGB: a street by day, at night and in snow."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "street"
        draw_streets(folder, num_frames=math.ceil(max(BATCHES) / 2), image_size=(size, size))
        return np.stack([read_image(path) for path in sorted(folder.rglob("*.png"))[: max(BATCHES)]])


def _resized(images: np.ndarray, size: int) -> np.ndarray:
    return np.stack([resize(image, (size, size)) for image in images])


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
    dense = compiled(model, lambda model, batch: model(preprocess(batch)))
    on_device = compiled(model, partial(extract, share=0.3))
    extractor = partial(D2NetFeatures, model, image_size=images.shape[2:0:-1])
    steps = {
        MAP: lambda _: partial(_on_device, dense),
        ON_DEVICE: lambda _: partial(_on_device, on_device),
        FEATURES: lambda count: extractor(batch_size=count),
    }
    entries = of_mfvpr(steps, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_networks import D2Net

        entries += of_torch({MAP: D2Net.forward, FEATURES: D2Net.extract}, loaded(D2Net(), D2NET, arrays), images)
    return entries


def of_mixvpr(images: np.ndarray) -> list[Entry]:
    """Descriptors on the host."""
    model, arrays = make_network(MIXVPR)
    step = "MixVPR descriptor"
    entries = of_mfvpr({step: lambda count: partial(MixVprDescriptor(model, batch_size=count), features=())}, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_networks import MixVPR

        entries += of_torch({step: MixVPR.describe}, loaded(MixVPR(), MIXVPR, arrays), images)
    return entries


def of_aliked(name: str, images: np.ndarray) -> list[Entry]:
    """Keypoints from host to host."""
    model, arrays = make_network(name)
    step = f"{name} features"
    extractor = partial(AlikedFeatures, model, image_size=images.shape[2:0:-1], threshold=THRESHOLD)
    entries = of_mfvpr({step: lambda count: extractor(batch_size=count)}, images)
    if find_spec("torch"):
        from experiments.benchmark.torch_aliked import Aliked

        module, note = loaded(Aliked(name, THRESHOLD), name, arrays), " (deformable convolution in Python)"
        entries += of_torch({step: Aliked.extract}, module, images, note)
    return entries


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


def loaded(module: Any, name: str, arrays: Mapping[str, np.ndarray]) -> Any:
    """The torch network with our arrays under the published keys, conversion backwards; ready for inference."""
    import torch

    state = module.state_dict()
    for key in state:
        for rule in network_of(entry_of(name)).table.rules:
            if match := re.fullmatch(rule.source, key):
                array, axes = arrays[match.expand(rule.target)], rule.layout.value
                state[key] = torch.from_numpy(np.array(array if axes is None else array.transpose(np.argsort(axes))))
    module.load_state_dict(state)
    return module.eval()


def of_torch(steps: Mapping[str, Callable], module: Any, images: np.ndarray, note: str = "") -> list[Entry]:
    """In both memory layouts; on a CPU one by one as well, as mfvpr does it. As precise as mfvpr on a GPU."""
    import torch

    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    device = "cuda" if torch.cuda.is_available() else "cpu"
    default, channels_last = (
        partial(_in_torch, deepcopy(module).to(device, memory_format=layout), layout)
        for layout in (torch.contiguous_format, torch.channels_last)
    )
    entries: list[Entry] = []
    for step, method in steps.items():
        for count in BATCHES:
            batch, where = images[:count], f"{step}, batch {count}"
            entries.append((where, f"torch{note}", partial(default, method, [batch])))
            entries.append((where, f"torch, channels last{note}", partial(channels_last, method, [batch])))
            if count > 1 and device == "cpu":
                one_by_one = partial(channels_last, method, np.split(batch, count))
                entries.append((where, f"torch, channels last, one by one{note}", one_by_one))
    return entries


def _in_torch(model: Any, layout: "torch.memory_format", method: Callable, batches: list[np.ndarray]) -> list[Any]:
    """What `method` gives for each image."""
    import torch

    results = []
    with torch.inference_mode():
        for batch in batches:
            on_device = torch.from_numpy(batch).to(next(model.parameters()).device)
            results += method(model, model.prepared(on_device).contiguous(memory_format=layout))
            if on_device.is_cuda:
                torch.cuda.synchronize()
    return results
