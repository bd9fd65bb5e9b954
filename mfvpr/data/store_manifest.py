"""What the rows of a store were made from, in plain text beside them: never mixed, never reused by mistake.

The manifest is the `zarr.json` of the store's Zarr group, in its attributes. It is written before anything else and
compared, ingredient by ingredient, whenever the store is opened.
"""

import hashlib
import itertools
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mfvpr.data.files import replacing
from mfvpr.errors import InputError

MANIFEST = "zarr.json"
_ABSENT = object()


@dataclass(frozen=True)
class Kind:
    """What a store holds, in the words of its manifest and of its messages.

    Attributes:
        store: what it is called.
        content: what a row is made of.
        rows: what a row belongs to.
        remake: what the next run does with a row that is not done.
    """

    store: str
    content: str
    rows: str
    remake: str

    @property
    def format(self) -> str:
        """Of the arrays on disk, with its version."""
        return f"mfvpr {self.store} 1"


FEATURES = Kind("feature store", "features", "images", "extracts")
MATCHES = Kind("match store", "matches", "queries", "matches")


def recipe_fingerprint(recipe: Mapping[str, Any], kind: Kind = FEATURES) -> str:
    """SHA-256 over the store's format and the recipe (JSON values only); the first 16 hexadecimal digits."""
    text = json.dumps({"format": kind.format, "recipe": recipe}, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
        foreign = sorted(path.name for path in folder.iterdir() if path.name != "lock" and not _is_leftover(path))
        if foreign:
            raise InputError(
                f"{folder}: expected a folder of {kind.content}, got one without {MANIFEST} that holds "
                f"{_short(foreign[0])}; choose another path"
            )


def settle_manifest(folder: Path, kind: Kind, recipe: Mapping[str, Any], sizes: Mapping[str, int]) -> None:
    """Write the manifest, or compare it with the one that is there. Whoever calls holds the store's lock.

    Args:
        folder: the store's.
        kind: what it holds.
        recipe: what that is made from.
        sizes: lengths of its axes by name, which the manifest tells as well.

    Raises:
        InputError: the store was made from something else, or its manifest cannot be understood.
        OSError: it cannot be read or written.
    """
    content = {"format": kind.format, **sizes, "recipe": recipe, "fingerprint": recipe_fingerprint(recipe, kind)}
    expected = json.loads(json.dumps(content))  # tuples become lists
    path = folder / MANIFEST
    if not path.exists():
        for leftover in filter(_is_leftover, folder.iterdir()):
            leftover.unlink()
        _write(path, expected)
    found = _read(path, kind)
    if difference := _difference(found, expected):
        raise InputError(
            f"{path}: these {kind.content} were made with {difference}; choose another path, or delete this folder"
        )


def _is_leftover(path: Path) -> bool:
    """A manifest that was being written when the process was killed."""
    return path.name.startswith(".zarr-") and path.suffix == ".json"


def _write(path: Path, manifest: Mapping[str, Any]) -> None:
    group = {"zarr_format": 3, "node_type": "group", "attributes": {"mfvpr": manifest}}
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(group, indent=1, sort_keys=True, allow_nan=False))
        file.flush()
        os.fsync(file.fileno())  # what comes later is on disk when it is written; so must this be


def _read(path: Path, kind: Kind) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))["attributes"]["mfvpr"]
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: expected the manifest of a {kind.store}, got something else; choose another path, or delete "
            "this folder"
        ) from None


def _difference(found: Any, expected: Any, name: str = "") -> str | None:
    """The first ingredient that differs, as `name=found, expected ...`; those of `expected` come first."""
    if isinstance(found, dict) and isinstance(expected, dict):
        parts = [
            (f"{name}.{key}".lstrip("."), found.get(key, _ABSENT), expected.get(key, _ABSENT))
            for key in {**expected, **found}
        ]
    elif isinstance(found, list) and isinstance(expected, list):
        pairs = itertools.zip_longest(found, expected, fillvalue=_ABSENT)
        parts = [(f"{name}[{place}]", *pair) for place, pair in enumerate(pairs)]
    elif type(found) is type(expected) and found == expected:
        return None
    else:
        return f"{name}={_short(found)}, expected {_short(expected)}"
    differences = (_difference(one, other, part) for part, one, other in parts)
    return next(filter(None, differences), None)


def _short(value: Any) -> str:
    text = "nothing" if value is _ABSENT else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
