"""What the rows of a store were made from, in plain text beside them: never mixed, never reused by mistake.

The manifest is written before anything else and compared, ingredient by ingredient, whenever the store is opened.
"""

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing
from mfvpr.utils.fingerprints import difference, fingerprint, shortened

MANIFEST = "manifest.json"
_OLD_MANIFEST = "zarr.json"  # of format 1
_LEFTOVER = re.compile(
    r"\.(manifest|images|bad|shortlist|vocabulary|\d+-\d+)-\w+\.(json|npz)"
)  # was being written when its process was killed


@dataclass(frozen=True)
class Kind:
    """What a store holds, in the words of its manifest and of its messages.

    Attributes:
        store: what it is called.
        version: of its arrays on disk.
        content: what a row is made of.
        rows: what a row belongs to.
        remake: what the next run does with a row that is not done; None = nothing can make it again, so that nothing is
            removed, and nobody is advised to.
        compress: whether that is worth its time.
    """

    store: str
    version: int
    content: str
    rows: str
    remake: str | None
    compress: bool

    @property
    def format(self) -> str:
        """What the manifest says of the arrays on disk."""
        return f"mfvpr {self.store} {self.version}"

    def advice(self, irreplaceable: str) -> str:
        """How to mend a store that cannot be used as it is; `irreplaceable` where no run can make it again."""
        return "choose another path, or delete this folder" if self.remake else irreplaceable


FEATURES = Kind("feature store", 3, "features", "images", "extracts", compress=False)
SCORES = Kind("score store", 1, "scores", "queries", "scores", compress=False)
VECTORS = Kind("descriptor store", 1, "global descriptors", "images", "describes", compress=False)
MATCHES = Kind("match store", 3, "matches", "queries", "matches", compress=True)


def recipe_fingerprint(recipe: Mapping[str, Any], kind: Kind = FEATURES) -> str:
    """SHA-256 over the store's format and the recipe (JSON values only); the first 16 hexadecimal digits."""
    return fingerprint({"format": kind.format, "recipe": recipe})


def store_path(root: Path, name: str, recipe: Mapping[str, Any], kind: Kind = FEATURES) -> Path:
    """`<root>/<name>-<fingerprint>`; characters of `name` that do not belong in a file name become `_`."""
    return root / f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)[:100]}-{recipe_fingerprint(recipe, kind)}"


def check_owned(folder: Path, kind: Kind) -> None:
    """Refuse to make a store of anything but a new or empty folder, or what an interrupted start left.

    Raises:
        InputError: `folder` is a file, or holds other things than a store.
        OSError: it cannot be read.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of {kind.content}, got a file; choose another path")
    if folder.is_dir() and not (folder / MANIFEST).exists():
        if (folder / _OLD_MANIFEST).exists():
            raise InputError(
                f"{folder}: expected {kind.format!r}, got the format of an earlier version; choose another path, or "
                "delete this folder"
            )
        foreign = sorted(path.name for path in folder.iterdir() if path.name != "lock" and not _is_leftover(path))
        if foreign and not (folder / MANIFEST).exists():  # another process may just have written it
            raise InputError(
                f"{folder}: expected a folder of {kind.content}, got one without {MANIFEST} that holds "
                f"{shortened(foreign[0])}; choose another path"
            )


def manifest_of(kind: Kind, recipe: Mapping[str, Any], sizes: Mapping[str, int]) -> dict[str, Any]:
    """What a manifest says (JSON).

    Args:
        kind: what the store holds.
        recipe: what that is made from.
        sizes: lengths of its axes by name.
    """
    content = {"format": kind.format, **sizes, "recipe": recipe, "fingerprint": recipe_fingerprint(recipe, kind)}
    return json.loads(json.dumps(content))  # tuples become lists


def is_settled(folder: Path, kind: Kind, manifest: Mapping[str, Any]) -> bool:
    """Whether the store has its manifest.

    Raises:
        InputError: the store was made from something else, or its manifest cannot be understood.
        OSError: it cannot be read.
    """
    path = folder / MANIFEST
    if not path.exists():
        return False
    if differs := difference(_read(path, kind), manifest):
        advice = kind.advice(f"use the settings that this {kind.store} was made with, or choose another path")
        raise InputError(f"{path}: these {kind.content} were made with {differs}; {advice}")
    return True


def settle_manifest(folder: Path, kind: Kind, manifest: Mapping[str, Any]) -> None:
    """Clear away what a killed process left, and write the manifest if it is not there. Whoever calls holds the lock.

    Raises:
        InputError: as `is_settled`.
        OSError: it cannot be read or written.
    """
    for leftover in filter(_is_leftover, folder.iterdir()):
        leftover.unlink()
    leave_manifest(folder, kind, manifest)


def leave_manifest(folder: Path, kind: Kind, manifest: Mapping[str, Any]) -> None:
    """Write the manifest if it is not there; several may, of one store.

    Raises:
        InputError: as `is_settled`.
        OSError: it cannot be read or written.
    """
    if not is_settled(folder, kind, manifest):
        _write(folder / MANIFEST, manifest)


def _is_leftover(path: Path) -> bool:
    return _LEFTOVER.fullmatch(path.name) is not None


def _write(path: Path, manifest: Mapping[str, Any]) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False))
        file.flush()
        os.fsync(file.fileno())  # what comes later is on disk when it is written; so must this be


def _read(path: Path, kind: Kind) -> Any:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if "format" in content:
            return content
    except (ValueError, TypeError):
        pass
    raise InputError(f"{path}: expected the manifest of a {kind.store}, got something else; "
                     f"{kind.advice('put back a copy of this file')}")  # fmt: skip
