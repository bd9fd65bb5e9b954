"""What a result was made from, in words that JSON takes, and its hash: the only fingerprints there are.

Stores, checkpoints and blocks are keyed by the recipe of what they hold, and compared with it, part by part.
"""

import functools
import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.utils.code_hash import behavior_of

_ABSENT = object()
_ADDRESS = re.compile(" at 0x[0-9a-f]+")  # of a network's functions, which every process has elsewhere


def recipe_of(value: Any, of_path: Callable[[PurePath], Any] = str) -> Any:
    """A value in JSON's terms, arrays by their content: what makes an extractor, a filter or a scorer what it is.

    Dataclasses are told by their class and fields, networks by their class and arrays; classes of one's own by their
    code as well, see `mfvpr.utils.code_hash`, but neither by what that calls nor by attributes that are no fields.
    Fields with the metadata `recipe` False (how many images go at a time, seconds) change nothing, and are left out.

    Args:
        value: dataclasses, mappings, lists, arrays, networks, texts, numbers, paths, and what has a property `recipe`,
            which then says all but the name of the class.
        of_path: what stands for a path; keys of mappings are always told by their names.

    Raises:
        TypeError: a part is none of these, such as a function: nobody knows what it does. A property `recipe` of its
            class would say.
    """
    value = value.item() if isinstance(value, np.number) else value
    if value is None or isinstance(value, bool | int | float | str):
        return value if not isinstance(value, float) or math.isfinite(value) else str(value)
    if not isinstance(value, type) and hasattr(value, "recipe"):
        return {"class": _name(type(value)), "recipe": recipe_of(value.recipe, of_path)}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: getattr(value, f.name) for f in fields(value) if f.metadata.get("recipe", True)}
        return _class(type(value), of_path) | recipe_of(parts, of_path)
    if isinstance(value, Mapping):
        return {str(name): recipe_of(part, of_path) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [recipe_of(part, of_path) for part in value]
    if isinstance(value, PurePath):
        return of_path(value)
    leaves, structure = jax.tree.flatten(value)
    arrays = leaves and all(isinstance(leaf, np.ndarray | np.generic | jax.Array) for leaf in leaves)
    if not arrays or isinstance(value, functools.partial):
        raise TypeError(f"{type(value).__name__}: expected a dataclass, arrays, or a property `recipe` that JSON takes")
    own = {} if jax.tree_util.all_leaves([value]) else _class(type(value), of_path)
    return own | {"sha256": content_hash(_ADDRESS.sub("", str(structure)), leaves)}


def _name(kind: type) -> str:
    """Ours may move from module to module; two of others may have one name."""
    return kind.__qualname__ if _is_ours(kind) else f"{kind.__module__}.{kind.__qualname__}"


def _class(kind: type, of_path: Callable[[PurePath], Any]) -> dict[str, Any]:
    """Ours by its name; that of others by its behavior as well."""
    if _is_ours(kind):
        return {"class": _name(kind)}
    bases = [base for base in kind.__mro__ if not _is_ours(base) and base is not object]
    behavior = [behavior_of(base, lambda part: recipe_of(part, of_path)) for base in bases]
    return {"class": _name(kind), "code": fingerprint(behavior)}


def _is_ours(kind: type) -> bool:
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


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
