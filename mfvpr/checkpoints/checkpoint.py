"""Read published checkpoints as plain data: of PyTorch in both formats, NumPy and MATLAB.

No code in a file is executed. A pickle may ask by name only for ordered dictionaries, tensors, parameters and the notes
of a training, which are skipped.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from mfvpr.io.containers import read_npy_header, reading, shorten
from mfvpr.io.object_files import ArrayUnpickler, DataUnpickler, open_torch_archive, read_matlab
from mfvpr.utils.errors import InputError


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Read arrays by key, in the file's own types.

    Keys are those of the tensors in PyTorch's files (below `model`, `state_dict` or `model_state_dict`, if nested),
    `layer.name` in NumPy's dictionaries of layers, and `variable.field.0` in MATLAB's structures and cells.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds other content.
    """
    path = Path(path)
    with reading(path, "a checkpoint file", "download it again"), path.open("rb") as file:
        start = file.read(64)
        file.seek(0)
        for magic, read in _READERS.items():
            if start.startswith(magic):
                return _require_tensors(read(file))
        kind = "an empty or text file, perhaps a web page" if start.isascii() else "another file"
        raise InputError(f"expected a checkpoint of torch, NumPy or MATLAB, got {kind}; download it again")


def _require_tensors(content: Any) -> dict[str, np.ndarray]:
    """Return the content of a file, or raise an InputError unless it is numbers by name."""
    if not isinstance(content, dict) or not content:
        got = "none" if content == {} else type(content).__name__
        raise InputError(f"expected tensors by name, got {got}; use the official file")
    for key, tensor in content.items():
        if not isinstance(key, str) or not isinstance(tensor, np.ndarray) or tensor.dtype.kind not in "fiub":
            got = f"{type(tensor).__name__} at {shorten(str(key))}"
            raise InputError(f"expected tensors by name, got {got}; use the official file")
    return dict(content)


def _read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a .npy file with a pickled dictionary of layers."""
    shape, _, dtype = read_npy_header(file)
    content = ArrayUnpickler(file).load() if dtype.hasobject else None
    if not isinstance(content, np.ndarray) or content.dtype != object or content.shape != shape:
        got = f"another object of {dtype} {[*shape]}"
        raise InputError(f"expected a dictionary of layers, got {got}; use the official file")
    [layers] = content.ravel().tolist()
    return {f"{layer}.{name}": array for layer, parts in layers.items() for name, array in parts.items()}


_WRAPPERS = ("model", "state_dict", "model_state_dict")
_CODES = dict(Float="f4", Double="f8", Long="i8", Int="i4", Short="i2", Char="i1", Byte="u1", Bool="?")  # of storages
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001  # the start of files from before torch 1.6, which are not zip files


class _Dictionary(dict):
    """An ordered dictionary, or a note of a training such as the command line: what else it holds is skipped."""

    def __init__(self, *_: Any) -> None:
        super().__init__()

    def __setstate__(self, state: Any) -> None:
        pass


def _view(storage: np.ndarray, offset: int, shape: Sequence[int], strides: Sequence[int], *_: Any) -> np.ndarray:
    """A tensor: a view of a storage; offset and strides count values. NumPy checks the bounds."""
    size = storage.itemsize
    return np.ndarray(shape, storage.dtype, storage, offset * size, [step * size for step in strides])


class _TensorUnpickler(DataUnpickler):
    """Unpickler of tensors; their storages are empty until `_tensors` reads the values."""

    names: ClassVar[Mapping[str, Any]] = {
        "torch._utils._rebuild_tensor_v2": _view,
        "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
        "argparse.Namespace": _Dictionary,  # itself, since a pickle makes its instances without a call
        **dict.fromkeys(("collections.OrderedDict", "_codecs.encode", "numpy.dtype"), _Dictionary),
        **{f"numpy.{core}.multiarray.scalar": _Dictionary for core in ("core", "_core")},
        **{f"torch.{part}{kind}Storage": code for part in ("", "storage.") for kind, code in _CODES.items()},
    }

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.storages: dict[str, np.ndarray] = {}

    def persistent_load(self, pid: Any) -> np.ndarray:
        match pid:
            case ("storage", str(code), str(key), _, int(count), *rest) if rest in ([], [None]):
                return self.storages.setdefault(key, np.empty(count, code))
        raise InputError("expected plain dense tensors, got another kind; use the official file")


def _read_zip(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a zip file with the values of each storage."""
    with open_torch_archive(file) as (archive, folder, content):
        has_order = f"{folder}byteorder" in archive.namelist()
        order = archive.read(f"{folder}byteorder").decode() if has_order else "little"
        unpickler = _TensorUnpickler(content)
        read_values = lambda key: archive.read(f"{folder}data/{key}")  # noqa: E731
        return _tensors(unpickler.load(), unpickler.storages, order, read_values)


def _read_legacy(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read five pickles (two numbers, byte order, content, keys of the storages), then the values of each storage."""
    if (_TensorUnpickler(file).load(), _TensorUnpickler(file).load()) != (_MAGIC, _PROTOCOL):
        raise InputError("expected a torch checkpoint, got another pickle; use the official file")
    order = "little" if _TensorUnpickler(file).load()["little_endian"] else "big"
    unpickler = _TensorUnpickler(file)
    content, keys = unpickler.load(), _TensorUnpickler(file).load()
    values = {}
    for key in keys:
        count = int.from_bytes(file.read(8), order)
        values[key] = file.read(count * unpickler.storages[key].itemsize)
    return _tensors(content, unpickler.storages, order, values.__getitem__)


def _tensors(content: Any, storages: Mapping[str, np.ndarray], order: str, read_values: Callable[[str], bytes]) -> Any:
    """Tensors in a pickle's content, after the values of their storages, in this byte order, were read."""
    for key, storage in storages.items():
        dtype = storage.dtype.newbyteorder(order)  # pyright: ignore[reportArgumentType]
        storage[:] = np.frombuffer(read_values(key), dtype, len(storage))
    if isinstance(content, dict):
        return next((content[key] for key in _WRAPPERS if isinstance(content.get(key), dict)), content)
    return content


# First bytes of a file -> reader; every binary pickle begins with the last ones.
_READERS = {b"PK": _read_zip, b"\x93NUMPY": _read_layers, b"MATLAB": read_matlab, b"\x80": _read_legacy}
