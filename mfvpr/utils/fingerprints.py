"""Recipes: everything that determines a result, as JSON values; their hashes, the fingerprints; versions of software.

Files of a cache are named by the fingerprint of their recipe. The recipe of a class of this library has its name and
its fields; a class of your own says by a `recipe` what else its results depend on, such as a version.
"""

import hashlib
import json
import math
import platform
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr import __version__

_PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "opencv-python-headless", "pillow")
_LIBRARY = __name__.partition(".")[0]  # names of its classes stand for their code
_ADDRESS = re.compile(" at 0x[0-9a-f]+")  # of a network's functions: another one in every process


def recipe_of(value: Any, of_path: Callable[[PurePath], Any] = str) -> Any:
    """The recipe of an extractor, a retrieval, a matcher or a scorer: JSON values, with hashes of arrays.

        class Edges:  # an extractor of your own
            recipe = "edges 1"  # text, a number, or a dictionary; change it when results change

    The recipe is that of `recipe`, and of the fields of a dataclass. Fields with the metadata `recipe` False (batch
    sizes, seconds) change no result and are left out. Classes of this library need no `recipe`; one of them that has it
    says everything by it. Fields of your own class that have no recipe, such as functions, are left to its `recipe`.

    Other parts are mappings, lists, arrays, networks of this library, texts, numbers, and paths, whose JSON values
    `of_path` gives. Anything else raises a `TypeError`.
    """
    value = value.item() if isinstance(value, np.number) else value
    if value is None or isinstance(value, bool | int | float | str):
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value
    if isinstance(value, Mapping):
        return {str(name): recipe_of(part, of_path) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [recipe_of(part, of_path) for part in value]
    if isinstance(value, PurePath):
        return of_path(value)
    kind = type(value)
    is_ours = _is_ours(kind)
    parts: dict[str, Any] = {"class": kind.__qualname__ if is_ours else f"{kind.__module__}.{kind.__qualname__}"}
    names_recipe = hasattr(value, "recipe") and not isinstance(value, type)
    if names_recipe and not is_ours:  # the recipe of one of our classes says nothing about a user's subclass
        owners = [each for each in kind.__mro__ if "recipe" in vars(each)]
        names_recipe = not owners or not _is_ours(owners[0])
    if names_recipe:
        parts["recipe"] = recipe_of(value.recipe, of_path)
    if is_dataclass(kind) and is_ours != names_recipe:  # one of ours that names its recipe says everything by it
        for field in fields(kind):
            if field.metadata.get("recipe", True):
                try:
                    parts[field.name] = recipe_of(getattr(value, field.name), of_path)
                except TypeError:
                    if not names_recipe:
                        raise
        return parts
    if names_recipe:
        return parts
    leaves, structure = jax.tree.flatten(value)
    is_leaf = jax.tree_util.all_leaves([value])
    arrays = leaves and all(isinstance(leaf, np.ndarray | np.generic | jax.Array) for leaf in leaves)
    if not arrays or not (is_leaf or is_ours or kind.__module__.startswith("flax")):
        raise TypeError(f"{kind.__name__} names no `recipe`")
    return ({} if is_leaf else parts) | {"sha256": content_hash(_ADDRESS.sub("", str(structure)), leaves)}


def _is_ours(kind: type) -> bool:
    return kind.__module__.partition(".")[0] == _LIBRARY


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


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of mfvpr and of the packages, by name."""
    packages = {package: version(package) for package in _PACKAGES}
    return {"mfvpr": __version__, "python": platform.python_version(), **packages}
