"""Commands of `mfvpr weights`, on the folder of installed weights."""

import shlex
import sys
from collections.abc import Iterable
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

from mfvpr.checkpoints import REGISTRY, entry_of, install, is_installed, load_model, own_entries, weights_folder
from mfvpr.checkpoints.files import check_published, check_sha256, file_sha256, installed_entry, read_manifest
from mfvpr.checkpoints.networks import Entry, blueprint, how_to_install
from mfvpr.cli.console import Progress, refuse
from mfvpr.report import Table
from mfvpr.utils import InputError
from mfvpr.utils.files import replacing

_CHUNK = 1 << 18  # bytes
_LARGE = 200  # MiB, which take some seconds to convert


def list_weights() -> None:
    """Print all checkpoints with licenses and whether they are installed."""
    header = ["name", "network", "official file", "license of code", "of weights", "installed", "MB"]
    rows = []
    for entry in (*REGISTRY.values(), *own_entries()):
        installed = "yes" if is_installed(entry) else "no"
        size = f"{entry.size / 1e6:.1f}" if entry.size else "-"
        licenses = (entry.code_license, entry.weights_license)
        file = f"yours, as {entry.like}" if entry.like else entry.file
        rows.append([entry.name, entry.network, file, *licenses, installed, size])
    print(Table(header, rows, text_columns=6).text(), end="")


def add(file: Path, name: str | None, own: str | None) -> None:
    """Install an official checkpoint, or weights of one's own."""
    entry = _entry_of(file, name)
    if file.is_file() and (megabytes := file.stat().st_size >> 20) > _LARGE:
        print(f"{file}: {megabytes:,} MiB to convert, some {max(1, megabytes // 50)} s", file=sys.stderr)
    path = install(file, entry.name, own=own)
    manifest = read_manifest(entry.name if own is None else f"own/{own}")
    origin = "" if entry.sha256 else f", from a file of sha256 {manifest.source_sha256[:12]}..., which nobody published"
    origin = origin if own is None else f", your own for the network of {entry.name}; use it as weights={manifest.name}"
    print(f"{path}: {manifest.name}, {manifest.parameters:,} parameters{origin}")


def verify(names: Iterable[str]) -> None:
    """Check runtime files against their manifests, and downloaded checkpoints against the published hashes."""
    entries = [installed_entry(name) for name in names]
    entries = entries or [entry for entry in (*REGISTRY.values(), *own_entries()) if any(_present_files(entry))]
    if not entries:
        print(f"nothing is installed in {weights_folder()}")
    bad = 0
    for entry in entries:
        try:
            print(f"{entry.name}: {_verify(entry)}")
        except InputError as error:
            print(f"{entry.name}: BAD, {str(error).removeprefix(f'{entry.name}: ')}")
            bad += 1
    if bad:
        refuse(f"{bad} of {len(entries)} could not be verified")


def download(name: str) -> None:
    """Download an official checkpoint into the weights folder, under its name only if its hash is the published one."""
    entry = entry_of(name)
    if entry.sha256 is None:
        raise InputError(f"{name}: no hash is published, so it cannot be fetched safely; get {entry.file} from "
                         f"{entry.source}, then: {how_to_install(entry)}")  # fmt: skip
    target = weights_folder() / entry.file
    size = f"{entry.size:,} bytes" if entry.size else "size not published"
    print(f"{entry.file}: {entry.source}, {size}, {entry.license}", flush=True)
    if target.is_file() and file_sha256(target) == entry.sha256:
        print(f"{target}: is there already, with the published hash")
    else:
        _fetch(entry, target)
        print(f"{target}: downloaded, with the published hash")
    print(f"to install it: mfvpr weights add {shlex.quote(str(target))}")


def _fetch(entry: Entry, target: Path) -> None:
    try:
        with (
            replacing(target) as temporary,
            urlopen(entry.source, timeout=30) as response,
            temporary.open("wb") as file,
            Progress(entry.file, entry.size or 0) as progress,
        ):
            while chunk := response.read(_CHUNK):
                progress.update(file.write(chunk))
                if entry.size and progress.n > entry.size:
                    break  # the hash will differ
            file.flush()
            check_sha256(file_sha256(temporary), entry, entry.source)
    except (OSError, HTTPException) as error:
        if isinstance(error, HTTPError):
            error.close()  # it is the server's response
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{entry.source}: could not be downloaded to {target.parent}: {reason}") from error


def _entry_of(file: Path, name: str | None) -> Entry:
    if name is not None:
        return entry_of(name)
    if known := [entry for entry in REGISTRY.values() if entry.file == file.name]:
        return known[0]
    if not file.exists():
        raise InputError(f"{file}: no such file")
    raise InputError(f"{file}: no official file name; say what it is with --as NAME, one of {', '.join(REGISTRY)}")


def _present_files(entry: Entry) -> tuple[bool, bool]:
    """Whether the weights folder has the entry's checkpoint, if its hash is published, and its runtime file."""
    folder = weights_folder()
    has_runtime_file = any((folder / f"{entry.name}{suffix}").exists() for suffix in (".safetensors", ".json"))
    return entry.sha256 is not None and (folder / entry.file).exists(), has_runtime_file


def _verify(entry: Entry) -> str:
    """Check the files of an entry and list the checks in words; raise an InputError if a check fails."""
    has_checkpoint, has_runtime_file = _present_files(entry)
    checks = []
    if has_checkpoint:
        check_published(weights_folder() / entry.file, entry)
        checks.append(f"{entry.file} has the published hash")
    if has_runtime_file or not has_checkpoint:
        load_model(entry.name)
        manifest, expected = read_manifest(entry.name), blueprint(entry).parameters
        if manifest.parameters != expected:
            raise InputError(f"expected {expected:,} parameters, got {manifest.parameters:,}")
        checks.append(f"{manifest.parameters:,} parameters as converted")
        if entry.sha256 is None:
            origin = "is your own" if entry.like else "nobody published"
            checks.append(f"from {manifest.source_file} of sha256 {manifest.source_sha256[:12]}..., which {origin}")
    return "good, " + ", ".join(checks)
