"""Recipes: everything that determines a result, as JSON values; and their hashes, the fingerprints.

Stores and checkpoints are named by the fingerprint of their recipe, and compared with the recipe, part by part.

The recipe of a user's class has its code, so that results of changed code are not reused: its compiled functions
(instructions, constants, names, defaults, closures), and its source text if there is one. Both are needed: a file may
have been edited since it was imported, and closures are not in the text. Functions that methods call do not count.
Class attributes count, private ones if they are values and not named `cache`. A closure or attribute that is neither
plain, an array nor a dataclass needs a recipe; without one, the class has none either.
"""

import functools
import hashlib
import inspect
import itertools
import json
import math
import re
import threading
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_ABSENT = object()
_ADDRESS = re.compile(" at 0x[0-9a-f]+")  # of a network's functions: another one in every process
_PARSING = threading.Lock()  # of source: Python 3.11 raises a SystemError if several threads do
_PLAIN = (bool, int, float, complex, str, bytes)
_NAMED = (Enum, PurePath, range, slice, np.ufunc, np.dtype)  # known by their `repr`
_CODE = (re.Pattern, types.BuiltinFunctionType, types.ModuleType)
_CONSTANTS = (*_PLAIN, *_NAMED, *_CODE, np.ndarray, np.generic, jax.Array, tuple, list, dict, set, frozenset, type)
_INERT = ("typing", "types", "dataclasses")  # modules of annotations and markers, which compute nothing
_SLOTS = (types.MemberDescriptorType, types.GetSetDescriptorType)


def recipe_of(value: Any, of_path: Callable[[PurePath], Any] = str) -> Any:
    """The recipe of an extractor, a retrieval or a scorer: JSON values, with hashes of arrays.

    A dataclass gives its class and fields, a network its class and arrays. Classes of users give their code as well,
    but neither the functions that it calls nor attributes that are no fields. Fields with the metadata `recipe` False
    (batch sizes, seconds) change no result and are left out.

    Parts are dataclasses, mappings, lists, arrays, networks, texts, numbers, paths, and objects with a property
    `recipe`, which gives everything but the name of the class. Other parts, such as functions, raise a `TypeError`.
    `of_path` gives the JSON values of a path; paths that are keys of mappings stay texts.
    """
    value = value.item() if isinstance(value, np.number) else value
    if value is None or isinstance(value, bool | int | float | str):
        return value if not isinstance(value, float) or math.isfinite(value) else str(value)
    if not isinstance(value, type) and hasattr(value, "recipe") and "recipe" not in _field_names(type(value)):
        return {"class": _name(type(value)), "recipe": recipe_of(value.recipe, of_path)} | _additions(value, of_path)
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
    network = {} if jax.tree_util.all_leaves([value]) else _class(type(value), of_path)
    return network | {"sha256": content_hash(_ADDRESS.sub("", str(structure)), leaves)}


def _name(kind: type) -> str:
    """The name of a class; of ours without the module, which may change, and as it was first in a recipe."""
    if _is_ours(kind):
        return getattr(kind, "recipe_name", kind.__qualname__)
    return f"{kind.__module__}.{kind.__qualname__}"


def _class(kind: type, of_path: Callable[[PurePath], Any]) -> dict[str, Any]:
    """The recipe of a class: its name, and its code unless the class is ours."""
    if _is_ours(kind):
        return {"class": _name(kind)}
    return {"class": _name(kind), "code": _code(kind.__mro__, of_path)}


def _code(kinds: Iterable[type], of_path: Callable[[PurePath], Any]) -> str:
    """Fingerprint of the code of users' classes; ours are left out."""
    bases = [base for base in kinds if not _is_ours(base) and base is not object]
    return fingerprint([_behavior(base, lambda part: recipe_of(part, of_path)) for base in bases])


def _additions(value: Any, of_path: Callable[[PurePath], Any]) -> dict[str, Any]:
    """Code and fields that a user's subclass adds to the class with the property `recipe`."""
    kinds = type(value).__mro__
    owner = next((kind for kind in kinds if "recipe" in vars(kind)), kinds[0])
    if owner is kinds[0] or _is_ours(kinds[0]):
        return {}
    own_fields = _field_names(kinds[0]) - _field_names(owner)
    parts = recipe_of({name: getattr(value, name) for name in sorted(own_fields)}, of_path)
    return {"code": _code(kinds[: kinds.index(owner)], of_path), "fields": parts}


def _field_names(kind: type) -> set[str]:
    return {field.name for field in fields(kind)} if is_dataclass(kind) else set()


def _behavior(kind: type, recipe_of: Callable[[Any], Any], seen: tuple[int, ...] = ()) -> list[Any]:
    """The code of a class without its bases; `recipe_of` raises a TypeError for a part without a recipe."""
    attributes = [(name, part) for name, part in sorted(vars(kind).items()) if _counts(name, part)]
    parts = [[name, _part(part, recipe_of, (*seen, id(kind)))] for name, part in attributes]
    return [kind.__qualname__, _text(kind), parts]


def _is_ours(kind: type) -> bool:
    """Whether a class is of this library, so that its name stands for its code."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


def _text(kind: type) -> str:
    try:
        with _PARSING:
            return inspect.getsource(kind)
    except (OSError, TypeError):  # typed into a terminal, or created by `type`
        return ""


def _counts(name: str, part: Any) -> bool:
    """True for functions and attributes, except names like `__doc__`, private caches and private objects."""
    if _functions(part) or isinstance(part, functools.partial) or not name.startswith("_"):
        return True
    is_dunder = name.startswith("__") and name.endswith("__")
    return (isinstance(part, _CONSTANTS) or is_dataclass(part)) and not is_dunder and "cache" not in name.lower()


def _functions(part: Any) -> list[Any]:
    """The functions of a method, of a property, or inside a wrapper."""
    if isinstance(part, property):
        return [function for function in (part.fget, part.fset, part.fdel) if function is not None]
    inner = getattr(part, "func", None) if isinstance(part, functools.cached_property) else None
    inner = inner or getattr(part, "__wrapped__", None) or getattr(part, "__func__", None)
    return [part] if isinstance(part, types.FunctionType) and inner is None else [inner] if inner is not None else []


def _part(part: Any, recipe_of: Callable[[Any], Any], seen: tuple[int, ...]) -> Any:
    if id(part) in seen:  # a function that closes over itself
        return "itself"

    def parts(values: Iterable[Any]) -> list[Any]:
        return [_part(value, recipe_of, (*seen, id(part))) for value in values]

    if isinstance(part, types.FunctionType):
        closure = [cell.cell_contents for cell in part.__closure__ or () if cell != types.CellType()]  # an empty cell
        return parts([part.__code__, part.__defaults__ or (), part.__kwdefaults__ or {}, *closure])
    if isinstance(part, types.CodeType):
        return [part.co_code.hex(), list(part.co_names), list(part.co_varnames), parts(part.co_consts)]
    if isinstance(part, functools.partial):
        return parts([part.func, part.args, part.keywords])
    if isinstance(part, types.MethodType):
        return parts([part.__func__, part.__self__])
    if functions := _functions(part):
        return parts(functions)
    if isinstance(part, tuple | list):
        return parts(part)
    if isinstance(part, dict):
        return [[str(name), *parts([value])] for name, value in part.items()]
    if isinstance(part, set | frozenset):
        return sorted(map(repr, part if all(isinstance(value, _PLAIN) for value in part) else parts(part)))
    if part is None or part is ... or isinstance(part, _PLAIN + _NAMED):
        return [type(part).__qualname__, repr(part)]
    if isinstance(part, type):
        return part.__qualname__
    if isinstance(part, re.Pattern):
        return ["Pattern", *parts([part.pattern, part.flags])]
    if isinstance(part, types.ModuleType):
        return ["module", part.__name__]
    if isinstance(part, types.BuiltinFunctionType):
        return [part.__qualname__, *parts([part.__self__])]
    if isinstance(part, _SLOTS) or type(part).__module__ in _INERT:
        return type(part).__qualname__
    if is_dataclass(part):
        code = [] if _is_ours(type(part)) or id(type(part)) in seen else [_behavior(type(part), recipe_of, seen)]
        return [type(part).__qualname__, *code, *parts(getattr(part, field.name) for field in fields(part))]
    return recipe_of(part)


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


def difference(value: Any, expected: Any, name: str = "") -> str | None:
    """The first difference of two JSON values as `name=value, expected ...`; names in `expected` come first."""
    if isinstance(value, dict) and isinstance(expected, dict):
        keys = {**expected, **value}
        parts = [(f"{name}.{key}".lstrip("."), value.get(key, _ABSENT), expected.get(key, _ABSENT)) for key in keys]
    elif isinstance(value, list) and isinstance(expected, list):
        pairs = itertools.zip_longest(value, expected, fillvalue=_ABSENT)
        parts = [(f"{name}[{index}]", *pair) for index, pair in enumerate(pairs)]
    elif type(value) is type(expected) and value == expected:
        return None
    else:
        return f"{name}={short_json(value)}, expected {short_json(expected)}"
    differences = (difference(part, expected_part, part_name) for part_name, part, expected_part in parts)
    return next(filter(None, differences), None)


def short_json(value: Any) -> str:
    """A JSON value for a message of one line."""
    text = "nothing" if value is _ABSENT else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
