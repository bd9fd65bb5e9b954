"""What a result was made from, in words that JSON takes, and its hash: the only fingerprints there are.

Stores, checkpoints and blocks are keyed by the recipe of what they hold, and compared with it, part by part.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_ABSENT = object()


def recipe_of(value: Any) -> Any:
    """A value in JSON's terms, arrays by their content: what makes an extractor, a filter or a scorer what it is.

    Dataclasses are told by the names of their class and fields, networks by their arrays. Fields with the metadata
    `recipe` False (how many images go at a time) change nothing, and are left out.

    Raises:
        TypeError: a part is none of these, such as a function: nobody knows what it does. A property `recipe` of its
            class would say.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if not isinstance(value, type) and hasattr(value, "recipe"):
        return recipe_of(value.recipe)
    if is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: getattr(value, f.name) for f in fields(value) if f.metadata.get("recipe", True)}
        return {"class": type(value).__name__} | recipe_of(parts)
    if isinstance(value, Mapping):
        return {str(name): recipe_of(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [recipe_of(part) for part in value]
    if isinstance(value, PurePath):
        return str(value)
    leaves, structure = jax.tree.flatten(value)
    if leaves and all(isinstance(leaf, np.ndarray | np.generic | jax.Array) for leaf in leaves):
        own = {} if jax.tree_util.all_leaves([value]) else {"class": type(value).__name__}
        return own | {"sha256": content_hash(str(structure), leaves)}
    raise TypeError(f"{type(value).__name__}: expected a dataclass, arrays, or a property `recipe` that JSON takes")


def fingerprint(recipe: Any) -> str:
    """SHA-256 over JSON values; the first 16 hexadecimal digits."""
    return hashlib.sha256(json.dumps(recipe, sort_keys=True, allow_nan=False).encode()).hexdigest()[:16]


def content_hash(*parts: Any) -> str:
    """SHA-256 over texts, and the types, shapes and bytes of the arrays in pytrees; the first 24 hexadecimal digits."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(parts):
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        array = np.frombuffer(leaf.encode(), np.uint8) if isinstance(leaf, str) else np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape};".encode() + array.tobytes())
    return digest.hexdigest()[:24]


def difference(found: Any, expected: Any, name: str = "") -> str | None:
    """What differs first in two JSON values, as `name=found, expected ...`; the names of `expected` come first."""
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
        return f"{name}={shortened(found)}, expected {shortened(expected)}"
    differences = (difference(one, other, part) for part, one, other in parts)
    return next(filter(None, differences), None)


def shortened(value: Any) -> str:
    """A JSON value for a message of one line."""
    text = "nothing" if value is _ABSENT else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
