"""The name, the place and the global descriptor of each image of a map on disk.

A row store (`mfvpr.storage.rows`). A row holds `vector` float32 `[D]` and `text` uint8, the JSON of name and place.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mfvpr.storage.manifest import Kind
from mfvpr.storage.rows import RowFormat, RowStore
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle

DEEPEST = 50  # levels of a place: Python's JSON reads fewer levels, the more functions are called already


class Entry(NamedTuple):
    """The data of an image in a map, without its features; the place is any JSON value."""

    name: str
    place: Any
    vector: Float[np.ndarray, " dimensions"]


EntryStore = RowStore[Entry]


def open_entry_store(folder: Path, recipe: Mapping[str, Any], *, num_images: int, kind: Kind, **how: Any) -> EntryStore:
    """The store in `folder`; see `features.open_store`."""
    return RowStore(folder, RowFormat(kind, _pack, _unpack), recipe, {"num_images": num_images}, **how)


def check_entry(name: Any, place: Any) -> None:
    """Refuse a name that is no text, and a place that is None or that JSON would change: a tuple becomes a list."""
    if not isinstance(name, str):
        raise InputError(f"name: expected text, got {clip_middle(repr(name), 80)}. Use `str(name)`.")
    try:
        text = json.dumps(place, allow_nan=False)
        if place is None or json.loads(text) != place:
            raise ValueError(f"{clip_middle(repr(place), 80)}, which JSON gives back as {clip_middle(text, 80)}")
        if _levels(place) > DEEPEST:
            raise RecursionError
    except RecursionError:
        message = f"{name}: expected a place of at most {DEEPEST} levels, got a deeper one; flatten it"
        raise InputError(message) from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected a place that JSON can say, and not null, got {error}; use text, numbers, "
                         "lists, and dictionaries by text") from None  # fmt: skip


def _levels(place: Any) -> int:
    """Depth of nested lists and dictionaries."""
    parts = place.values() if isinstance(place, dict) else place if isinstance(place, list) else None
    return 0 if parts is None else 1 + max(map(_levels, parts), default=0)


def _pack(entry: Entry) -> dict[str, np.ndarray]:
    text = json.dumps([entry.name, entry.place], allow_nan=False)
    return {"vector": np.asarray(entry.vector, np.float32), "text": np.frombuffer(text.encode("ascii"), np.uint8)}


def _unpack(parts: Mapping[str, np.ndarray]) -> Entry:
    name, place = json.loads(parts["text"].tobytes().decode("ascii"))
    return Entry(name, place, parts["vector"])
