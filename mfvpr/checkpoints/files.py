"""Runtime files of weights: `<name>.safetensors` and its manifest `<name>.json`, verified when they are loaded."""

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import safetensors.numpy

from mfvpr.checkpoints.checkpoint import read_checkpoint, require_checkpoint
from mfvpr.checkpoints.conversion import convert
from mfvpr.checkpoints.networks import (
    NETWORKS,
    OWN,
    REGISTRY,
    RUNTIME,
    Entry,
    blueprint,
    entry_of,
    how_to_install,
    own_entry,
)
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing, require_file, write_text

if TYPE_CHECKING:
    from flax import nnx

_MEND = "install it again"


@dataclass(frozen=True)
class Manifest:
    """Name and hash of a runtime file, and the checkpoint it comes from."""

    name: str
    sha256: str
    parameters: int  # of the network, without running statistics
    source_file: str
    source_sha256: str
    like: str = ""  # weights of one's own: the published weights of the same network


class WeightsError(InputError):
    """Weights are not installed, or their file has changed. The message ends with the command that installs them."""

    def __init__(self, message: str, entry: Entry) -> None:
        super().__init__(message, entry)

    def __str__(self) -> str:
        return f"{self.args[0]}: {how_to_install(self.args[1])}"


def weights_folder() -> Path:
    """Folder of the runtime files: the environment variable MFVPR_WEIGHTS, or ~/.cache/mfvpr/weights."""
    return Path(os.path.expanduser(os.environ.get("MFVPR_WEIGHTS") or "~/.cache/mfvpr/weights"))


def install(checkpoint: Path, name: str, *, own: str | None = None) -> Path:
    """Convert a checkpoint to a runtime file; the checkpoint does not change.

    Args:
        checkpoint: the official file, or one with its keys and shapes; a runtime file if the weights are your own.
        name: of the published weights.
        own: name of weights of your own, for the network of `name`. They are installed as `own/<name>`.

    Raises:
        InputError: the name is unknown, or the file is no checkpoint, not the published one, or of another network.
    """
    entry = entry_of(name) if own is None else own_entry(f"{OWN}{own}", name)
    if own is not None and is_installed(entry):
        raise InputError(f"{entry.name}: expected a name that is free, got one of installed weights; choose another")
    network, is_runtime_file = NETWORKS[name], own is not None and checkpoint.suffix == ".safetensors"
    if is_runtime_file:
        require_file(checkpoint, "a safetensors file")
        network, tensors = network._replace(table=RUNTIME), _parse(checkpoint.read_bytes(), f"{checkpoint}: ")
    else:
        require_checkpoint(checkpoint)  # first, since "a web page" helps more than another hash
        check_published(checkpoint, entry)
        tensors = read_checkpoint(checkpoint)
    plan = blueprint(entry)
    try:
        arrays = convert(tensors, network.table, plan.shapes)
    except InputError as error:
        raise InputError(f"{checkpoint}: {error}; use the official {entry_of(name).file}") from error
    return save(entry, arrays, checkpoint, parameters=plan.parameters)


def check_published(checkpoint: Path, entry: Entry) -> None:
    """Raise an InputError if a file has another hash than the published one, or cannot be read."""
    if entry.sha256 is not None:
        check_sha256(file_sha256(checkpoint), entry, checkpoint)


def check_sha256(sha256: str, entry: Entry, origin: object) -> None:
    """Raise an InputError that begins with `origin` unless the hash is the published one."""
    if sha256 != entry.sha256:
        names = [other.name for other in REGISTRY.values() if other.sha256 == sha256]
        got = f"that of {names[0]}" if names else f"{sha256[:12]}...: damaged, or another file"
        got += "" if names else "; weights of your own need a name: mfvpr weights add FILE --own NAME"
        raise InputError(f"{origin}: expected the sha256 of {entry.name}, {str(entry.sha256)[:12]}..., got {got}")


def save(entry: Entry, arrays: Mapping[str, np.ndarray], source: Path, *, parameters: int) -> Path:
    """Write the arrays by dotted path, then the manifest; `load` raises an error for a file without a manifest.

    `source` is the checkpoint of the arrays; `parameters` is their number, of the network.

    Raises:
        InputError: values are not finite.
    """
    for path, array in arrays.items():
        if not np.isfinite(array).all():
            raise InputError(f"{source}: expected finite values, got NaN or infinity in {path}; use the official file")
    content = safetensors.numpy.save({path: np.ascontiguousarray(array) for path, array in arrays.items()})
    target = _path(entry)
    with replacing(target) as temporary:
        temporary.write_bytes(content)
    sha256 = hashlib.sha256(content).hexdigest()
    manifest = Manifest(entry.name, sha256, parameters, source.name, file_sha256(source), entry.like or "")
    write_text(target.with_suffix(".json"), json.dumps(asdict(manifest), indent=1) + "\n")
    return target


def load(name: str) -> dict[str, np.ndarray]:
    """Read arrays by dotted path, from a file whose hash is that of its manifest.

    Raises:
        InputError: the name is unknown.
        WeightsError: the weights are not installed, the manifest is missing or of other weights, or a file is damaged.
    """
    entry, manifest = installed_entry(name), read_manifest(name)
    path = _path(entry)
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != manifest.sha256:
        raise WeightsError(f"{path}: the file has changed since it was written (sha256 differs); {_MEND}", entry)
    try:
        return _parse(content, f"{path}: ")
    except InputError as error:
        raise WeightsError(f"{error}; {_MEND}", entry) from error


def _parse(content: bytes, origin: str) -> dict[str, np.ndarray]:
    try:
        return safetensors.numpy.load(content)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{origin}expected a safetensors file, got: {error}") from error


def installed_entry(name: str) -> Entry:
    """`entry_of`, also for installed weights of one's own (`own/<name>`)."""
    return {entry.name: entry for entry in own_entries()}.get(name) or entry_of(name)


def own_entries() -> list[Entry]:
    """Entries of the weights of one's own that are installed."""
    entries = []
    for path in sorted(weights_folder().glob(f"{OWN}*.json")):
        with suppress(OSError, ValueError, LookupError, TypeError):  # damaged: not installed
            entries.append(own_entry(f"{OWN}{path.stem}", json.loads(path.read_text(encoding="utf-8"))["like"]))
    return entries


def load_model(name: str) -> "nnx.Module":
    """Load the network of this name with its weights, ready for inference.

    Raises:
        InputError: the name is unknown.
        WeightsError: as `load`; or the arrays do not fit the network.
    """
    entry, arrays = installed_entry(name), load(name)
    try:
        return blueprint(entry).build(arrays)
    except InputError as error:  # the file comes from another version of the network
        raise WeightsError(f"{_path(entry)}: {error}; {_MEND}", entry) from error


def read_manifest(name: str) -> Manifest:
    """Read the manifest of an installed runtime file, but not the file.

    Raises:
        WeightsError: the weights are not installed, or have no manifest of this name.
    """
    entry = installed_entry(name)
    path = _path(entry).with_suffix(".json")
    if not path.with_suffix(".safetensors").is_file():
        source = f"{entry.file} from {entry.source} ({entry.license})"
        raise WeightsError(f"{name}: not installed in {path.parent}; get {source} and install it", entry)
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        manifest = Manifest(**{each.name: values[each.name] for each in fields(Manifest) if each.name in values})
    except FileNotFoundError as error:
        raise WeightsError(f"{path}: there is no manifest, so the file was never finished; {_MEND}", entry) from error
    except (ValueError, TypeError) as error:
        raise WeightsError(f"{path}: expected a manifest; {_MEND}", entry) from error
    if manifest.name != name:
        raise WeightsError(f"{path}: expected the manifest of {name}, got that of {manifest.name}; {_MEND}", entry)
    return manifest


def is_installed(entry: Entry) -> bool:
    """Whether the runtime file and its manifest exist; `load` verifies them."""
    path = _path(entry)
    return path.is_file() and path.with_suffix(".json").is_file()


def file_sha256(path: Path) -> str:
    """The sha256 of a file of any size; an InputError if it is none, such as a pipe."""
    require_file(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _path(entry: Entry) -> Path:
    return weights_folder() / f"{entry.name}.safetensors"
