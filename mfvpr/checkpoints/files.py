"""Runtime files of weights, `<name>.safetensors`: installed from checkpoints, verified when they are loaded."""

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.numpy

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import RUNTIME, convert
from mfvpr.checkpoints.networks import (
    CUSTOM_PREFIX,
    RECOMMENDED,
    Entry,
    custom_entry,
    entry_of,
    how_to_install,
    plan_network,
)
from mfvpr.io.containers import reading
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing, require_file

if TYPE_CHECKING:
    from flax import nnx

_PROVENANCE = "mfvpr"  # key of a runtime file's metadata


class WeightsError(InputError):
    """Weights are not installed, or their file is damaged. The message ends with the command that installs them."""


def weights_folder() -> Path:
    """Folder of the runtime files: the environment variable MFVPR_WEIGHTS, or ~/.cache/mfvpr/weights."""
    return Path(os.path.expanduser(os.environ.get("MFVPR_WEIGHTS") or "~/.cache/mfvpr/weights"))


def install(checkpoint: Path, name: str, *, custom_name: str | None = None) -> Path:
    """Convert a checkpoint to a runtime file; the checkpoint does not change.

    Args:
        checkpoint: the official file, or one with its keys and shapes; a runtime file if the weights are your own.
        name: of the published weights.
        custom_name: of weights of your own, for the network of `name`. They are installed as `own/<custom_name>`.

    Raises:
        InputError: the name is unknown, or the file is no checkpoint, not the published one, or of another network.
    """
    entry = entry_of(name)
    if custom_name is not None:
        entry = custom_entry(f"{CUSTOM_PREFIX}{custom_name}", name)
        if is_installed(entry):
            raise InputError(f"{entry.name}: expected a name that is free, got installed weights; choose another")
    sha256 = check_sha256(checkpoint, entry, checkpoint)
    if custom_name is not None and checkpoint.suffix == ".safetensors":
        with reading(checkpoint, "a safetensors file"):
            table, tensors = RUNTIME, _read(checkpoint)[1]
    else:
        table, tensors = entry.table, read_checkpoint(checkpoint)
    plan = plan_network(entry.builder())
    try:
        arrays = convert(tensors, table, plan.shapes)
    except InputError as error:
        raise InputError(f"{checkpoint}: {error}; use the official {entry_of(name).file}") from error
    return save(entry, arrays, checkpoint, parameters=plan.parameters, sha256=sha256)


def check_sha256(file: Path, entry: Entry, origin: object) -> str:
    """The hash of a file; an InputError that begins with `origin` if another one is published."""
    sha256 = file_sha256(file)
    if entry.sha256 not in (None, sha256):
        expected, mend = f"the sha256 of {entry.name}, {entry.sha256[:12]}...", "weights of your own need --own NAME"
        raise InputError(f"{origin}: expected {expected}, got {sha256[:12]}...; {mend}")
    return sha256


def save(
    entry: Entry, arrays: Mapping[str, np.ndarray], source: Path, *, parameters: int, sha256: str | None = None
) -> Path:
    """Write the arrays by dotted path, and where they come from; an InputError if values are not finite.

    `source` is their checkpoint, `sha256` its hash, if it is known; `parameters` is their number, without running
    statistics.
    """
    for path, array in arrays.items():
        if not np.isfinite(array).all():
            raise InputError(f"{source}: expected finite values, got NaN or infinity in {path}; use the official file")
    provenance = {"name": entry.name, "like": entry.like, "sha256": _digest(arrays), "parameters": parameters}
    provenance |= {"source_file": source.name, "source_sha256": sha256 or file_sha256(source)}
    contiguous = {path: np.ascontiguousarray(array) for path, array in arrays.items()}
    with replacing(_path(entry)) as temporary:
        temporary.write_bytes(safetensors.numpy.save(contiguous, {_PROVENANCE: json.dumps(provenance)}))
    return _path(entry)


def load(name: str) -> dict[str, np.ndarray]:
    """Read arrays by dotted path, and compare them with the hash of their file's metadata.

    An InputError for an unknown name, a WeightsError if they are not installed, damaged or other weights.
    """
    provenance, entry = read_provenance(name), installed_entry(name)
    with suppress(safetensors.SafetensorError):
        arrays = _read(_path(entry))[1]
        if _digest(arrays) == provenance["sha256"]:
            return arrays
    raise _error(entry, "the file has changed since it was written (sha256 differs)")


def load_model(name: str) -> "nnx.Module":
    """Load the network of this name with its weights, ready for inference.

    An InputError for an unknown name, a WeightsError if the weights are not installed, damaged or other weights.
    """
    entry, arrays = installed_entry(name), load(name)
    try:
        return plan_network(entry.builder()).build(arrays)
    except InputError as error:  # the file comes from another version of the network
        raise _error(entry, str(error)) from error


def read_provenance(name: str) -> dict[str, Any]:
    """Read the metadata of an installed file, but not its arrays; errors are those of `load`.

    They are `name`, the `sha256` of the arrays, the number of `parameters` without running statistics, `source_file`
    and `source_sha256`, and for weights of your own the published weights that they are `like`.
    """
    entry = installed_entry(name)
    if not is_installed(entry):
        source, command = f"{entry.file} from {entry.source} ({entry.license})", how_to_install(entry)
        if entry.name in RECOMMENDED:
            command += ", or with all that system=mfvpr and system=fast need: mfvpr weights download recommended"
        raise WeightsError(f"{name}: not installed in {weights_folder()}; get {source} and install it: {command}")
    with suppress(safetensors.SafetensorError, ValueError):
        provenance = _read(_path(entry), with_arrays=False)[0]
        if provenance.get("name") == name:
            return provenance
    raise _error(entry, "expected a file of these weights with its metadata")


def installed_entry(name: str) -> Entry:
    """`entry_of`, also for installed weights of your own (`own/<name>`)."""
    entries = custom_entries() if name.startswith(CUSTOM_PREFIX) else []
    return next((entry for entry in entries if entry.name == name), None) or entry_of(name)


def custom_entries() -> list[Entry]:
    """Entries of the weights of your own that are installed."""
    entries = []
    for path in sorted(weights_folder().glob(f"{CUSTOM_PREFIX}*.safetensors")):
        with suppress(safetensors.SafetensorError, ValueError, LookupError):  # damaged: not installed
            entries.append(custom_entry(f"{CUSTOM_PREFIX}{path.stem}", _read(path, with_arrays=False)[0]["like"]))
    return entries


def is_installed(entry: Entry) -> bool:
    """Whether the runtime file exists; `load` verifies it."""
    return _path(entry).is_file()


def file_sha256(path: Path) -> str:
    """The sha256 of a file of any size; an InputError if it is none, such as a pipe."""
    require_file(path, "a checkpoint file")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path, *, with_arrays: bool = True) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Provenance, {} if there is none, and arrays of a runtime file."""
    with safetensors.safe_open(path, "numpy") as file:
        arrays = {key: file.get_tensor(key) for key in (file.keys() if with_arrays else ())}
        return json.loads((file.metadata() or {}).get(_PROVENANCE, "{}")), arrays


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Hash of paths, shapes and values."""
    digest = hashlib.sha256()
    for path, array in sorted(arrays.items()):
        digest.update(f"{path} {array.dtype} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _error(entry: Entry, message: str) -> WeightsError:
    return WeightsError(f"{_path(entry)}: {message}; install it again: {how_to_install(entry)}")


def _path(entry: Entry) -> Path:
    return weights_folder() / f"{entry.name}.safetensors"
