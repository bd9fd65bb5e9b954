"""Reads torch checkpoints as plain data: tensors come out as arrays, and nothing in the file is executed."""

import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mfvpr.errors import InputError

_WRAPPERS = ("model", "state_dict")


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Tensors by key, in the file's own types (bfloat16 as float32); those below `model` or `state_dict`, if nested.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds anything but data; or torch is missing.
    """
    path = Path(path)
    _check_file(path)
    content = _loaded(path)
    for key in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
            break
    if not isinstance(content, Mapping) or not content:
        kind = f"an empty {type(content).__name__}" if content == {} else type(content).__name__
        raise InputError(f"{path}: expected tensors by name, got {kind}; use the official file")
    return {str(key): _array(path, str(key), value) for key, value in content.items()}


def _check_file(path: Path) -> None:
    """Refuse what needs no torch to be told from a checkpoint."""
    again = "download it again"
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise InputError(f"{path}: expected a checkpoint file, got {'a folder' if path.is_dir() else 'no plain file'}")
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: expected a checkpoint file, got: {error.strerror}") from error
    if not start:
        raise InputError(f"{path}: expected a checkpoint, got an empty file; {again}")
    if start.startswith(b"PK"):
        if not zipfile.is_zipfile(path):
            raise InputError(f"{path}: this checkpoint is truncated; {again}")
    elif not start.startswith(b"\x80"):  # the first byte of every binary pickle
        kind = "a text file, perhaps a web page" if start.isascii() and b"\0" not in start else "another kind of file"
        raise InputError(f"{path}: expected a torch checkpoint, got {kind}; {again}")


def _torch() -> ModuleType:
    try:
        import torch
    except ImportError as error:
        raise InputError("converting checkpoints needs PyTorch, and nothing else does: pip install torch") from error
    return torch


def _loaded(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's remarks on how the file was written
        torch = _torch()
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            wanted = re.search(r"GLOBAL ([\w.]+)", str(error))
            what = f"it asks for {wanted[1]}" if wanted else "its pickle is damaged or more than data"
            reason = f"{what}; nothing was executed, use the official file"
        except Exception:  # torch raises half a dozen kinds, its own texts are paragraphs
            reason = "this checkpoint is damaged; download it again"
    raise InputError(f"{path}: {reason}")


def _array(path: Path, key: str, value: Any) -> np.ndarray:
    torch = _torch()
    if not isinstance(value, torch.Tensor):
        raise InputError(f"{path}: expected tensors only, got {type(value).__name__} at {key}")
    value = value.detach()
    if value.layout is not torch.strided or value.is_quantized:
        raise InputError(f"{path}: expected dense tensors, got {value.layout} at {key}")
    return (value.float() if value.dtype is torch.bfloat16 else value).numpy()
