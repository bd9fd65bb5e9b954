"""The manifest of a store: the recipe of its rows in plain text, written first and compared at every opening."""

import json
import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing
from mfvpr.utils.fingerprints import difference, fingerprint, short_json

MANIFEST = "manifest.json"
LOCKS = "locks"  # folder of the locks of a store that several processes write
# Temporary files of a process that was killed while it wrote.
_LEFTOVER = re.compile(r"\.(manifest|images|vocabulary|[0-9a-f]+-\d+)-\w+\.(json|npz)")
_ABANDONED = 3600  # seconds, after which a temporary file belongs to no running process: files are written within one


@dataclass(frozen=True)
class Kind:
    """A kind of store, in the words of its manifest and of its messages."""

    store: str
    version: int  # of its arrays on disk
    content: str  # of a row
    rows: str  # the things that rows belong to
    remake: str | None  # verb for making a row again; None = no run can, so that nothing is removed
    compress: bool

    @property
    def format(self) -> str:
        """The version of the arrays on disk, as it stands in the manifest."""
        return f"mfvpr {self.store} {self.version}"

    def advice(self, irreplaceable: str) -> str:
        """Advice for a store that cannot be used as it is; `irreplaceable` if no run can make it again."""
        return "choose another path, or delete this folder" if self.remake else irreplaceable


FEATURES = Kind("feature store", 3, "features", "images", "extracts", compress=False)
VECTORS = Kind("descriptor store", 1, "global descriptors", "images", "describes", compress=False)
MATCHES = Kind("match store", 3, "matches", "queries", "matches", compress=True)


def recipe_fingerprint(recipe: Mapping[str, Any], kind: Kind = FEATURES) -> str:
    """`fingerprint` of the store's format and the recipe (JSON values only)."""
    return fingerprint({"format": kind.format, "recipe": recipe})


def store_path(root: Path, name: str, recipe: Mapping[str, Any], kind: Kind = FEATURES) -> Path:
    """`<root>/<name>-<fingerprint>`; characters of `name` that do not belong in a file name become `_`."""
    return root / f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)[:100]}-{recipe_fingerprint(recipe, kind)}"


def check_folder(folder: Path, kind: Kind) -> None:
    """Raise `InputError` unless a folder is new or empty, a store, or left by an interrupted start."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of {kind.content}, got a file; choose another path")
    if folder.is_dir() and not (folder / MANIFEST).exists():
        foreign = sorted(
            path.name for path in folder.iterdir() if path.name not in ("lock", LOCKS) and not _is_leftover(path)
        )
        if foreign and not (folder / MANIFEST).exists():  # it may have appeared since
            raise InputError(
                f"{folder}: expected a folder of {kind.content}, got one without {MANIFEST} that holds "
                f"{short_json(foreign[0])}; choose another path"
            )


def manifest_of(kind: Kind, recipe: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any]:
    """The content of a manifest (JSON values): kind, recipe of the rows, and lengths of the store's axes by name."""
    content = {"format": kind.format, **sizes, "recipe": recipe, "fingerprint": recipe_fingerprint(recipe, kind)}
    return json.loads(json.dumps(content))  # tuples become lists


def has_manifest(folder: Path, kind: Kind, manifest: Mapping[str, Any]) -> bool:
    """Whether the store has its manifest; raises `InputError` if that has another recipe, or is damaged."""
    path = folder / MANIFEST
    if not path.exists():
        return False
    if differs := difference(_read(path, kind), manifest):
        advice = kind.advice(f"use the settings that this {kind.store} was made with, or choose another path")
        raise InputError(f"{path}: these {kind.content} were made with {differs}; {advice}")
    return True


def remove_store_leftovers(folder: Path) -> None:
    """Remove temporary files of killed processes; others may be writing."""
    for leftover in filter(_is_leftover, folder.iterdir() if folder.is_dir() else ()):
        with suppress(FileNotFoundError):
            if leftover.stat().st_mtime < time.time() - _ABANDONED:
                leftover.unlink()


def write_manifest(folder: Path, kind: Kind, manifest: Mapping[str, Any]) -> None:
    """Write the manifest if it is not there, as several processes may do; raises as `has_manifest`."""
    if not has_manifest(folder, kind, manifest):
        with replacing(folder / MANIFEST) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.write(json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False))
            file.flush()
            os.fsync(file.fileno())  # rows must not be on disk before


def _is_leftover(path: Path) -> bool:
    return _LEFTOVER.fullmatch(path.name) is not None


def _read(path: Path, kind: Kind) -> Any:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if "format" in content:
            return content
    except (ValueError, TypeError):
        pass
    raise InputError(f"{path}: expected the manifest of a {kind.store}, got something else; "
                     f"{kind.advice('put back a copy of this file')}")  # fmt: skip
