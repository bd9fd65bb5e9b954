"""Checkpoints without torch: a reader of its zip files, and random weights under the public names and shapes."""

import math
import pickle
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

ALIKED = Path(__file__).parent.parent.parent / "shared" / "weights" / "aliked"
_STORAGES = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
}


class _Unpickler(pickle.Unpickler):
    """Knows ordered dictionaries and tensors, and nothing that could run."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        super().__init__(archive.open(name))
        self._archive, self._folder = archive, name.removesuffix("data.pkl")

    def find_class(self, module: str, name: str) -> object:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")

    def persistent_load(self, pid: tuple) -> np.ndarray:
        _, dtype, key, *_ = pid
        return np.frombuffer(self._archive.read(f"{self._folder}data/{key}"), dtype)


def _tensor(storage: np.ndarray, offset: int, size: tuple, stride: tuple, *_: object) -> np.ndarray:
    strides = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, strides, writeable=False).copy()


def read_zip(path: Path) -> dict:
    """What `torch.save` wrote, tensors as arrays."""
    with zipfile.ZipFile(path) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        return _Unpickler(archive, name).load()


def random_checkpoint(shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> dict[str, np.ndarray]:
    """Plausible weights: each depends on its name, its shape and the seed alone."""
    return {name: _random(name, shape, seed) for name, shape in shapes.items()}


def _random(name: str, shape: tuple[int, ...], seed: int) -> np.ndarray:
    if name.endswith("num_batches_tracked"):
        return np.full(shape, 1000, np.int64)
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    normal = rng.standard_normal(shape)
    if name.endswith("running_var"):
        values = 1 + 0.5 * np.tanh(normal)
    elif name.endswith(("bias", "running_mean")):
        values = 0.05 * normal
    elif len(shape) < 2:  # the scale of a normalization
        values = 1 + 0.1 * normal
    else:  # He et al.: keeps the variance through a ReLU
        values = math.sqrt(2 / math.prod(shape[1:])) * normal
    return values.astype(np.float32)


def at_hand() -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """(name, tensors): random ones of D2-Net and MixVPR, and ALIKED's real ones where they are."""
    yield "d2_tf", random_checkpoint(d2net_shapes())
    yield "mixvpr_4096", random_checkpoint(mixvpr_shapes())
    for path in sorted(ALIKED.glob("*.pth")):
        yield path.stem, read_zip(path)


def d2net_shapes() -> dict[str, tuple[int, ...]]:
    """The tensors of d2_tf.pth, which holds them below the key `model`."""
    widths = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256),
              17: (256, 512), 19: (512, 512), 21: (512, 512)}  # fmt: skip
    shapes = {}
    for index, (inputs, outputs) in widths.items():
        shapes[f"dense_feature_extraction.model.{index}.weight"] = (outputs, inputs, 3, 3)
        shapes[f"dense_feature_extraction.model.{index}.bias"] = (outputs,)
    return shapes


def mixvpr_shapes(out_channels: int = 1024, out_rows: int = 4) -> dict[str, tuple[int, ...]]:
    """The tensors of MixVPR's checkpoints: ResNet-50 to its third layer, the mixer, two projections."""
    shapes = {"backbone.model.conv1.weight": (64, 3, 7, 7), **_norm("backbone.model.bn1", 64)}
    inputs = 64
    for layer, (blocks, width) in enumerate(((3, 64), (4, 128), (6, 256)), start=1):
        for block in range(blocks):
            prefix = f"backbone.model.layer{layer}.{block}"
            sizes = ((width, inputs, 1, 1), (width, width, 3, 3), (4 * width, width, 1, 1))
            for index, size in enumerate(sizes, start=1):
                shapes[f"{prefix}.conv{index}.weight"] = size
                shapes |= _norm(f"{prefix}.bn{index}", size[0])
            if block == 0:
                shapes[f"{prefix}.downsample.0.weight"] = (4 * width, inputs, 1, 1)
                shapes |= _norm(f"{prefix}.downsample.1", 4 * width)
            inputs = 4 * width
    for mixer in range(4):
        prefix = f"aggregator.mix.{mixer}.mix"
        shapes |= {f"{prefix}.0.weight": (400,), f"{prefix}.0.bias": (400,)}
        for layer in (1, 3):
            shapes |= {f"{prefix}.{layer}.weight": (400, 400), f"{prefix}.{layer}.bias": (400,)}
    shapes |= {"aggregator.channel_proj.weight": (out_channels, 1024), "aggregator.channel_proj.bias": (out_channels,)}
    return shapes | {"aggregator.row_proj.weight": (out_rows, 400), "aggregator.row_proj.bias": (out_rows,)}


def _norm(prefix: str, width: int) -> dict[str, tuple[int, ...]]:
    names = ("weight", "bias", "running_mean", "running_var")
    return {f"{prefix}.{name}": (width,) for name in names} | {f"{prefix}.num_batches_tracked": ()}
