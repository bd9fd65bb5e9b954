"""The code of a user's class as JSON values, so that results of changed code are not reused.

Compiled functions count (instructions, constants, names, defaults, closures), and the source text of the class if there
is one. Both are needed: a file may have been edited since it was imported, and closures are not in the text. Functions
that methods call do not count. Class attributes count, private ones if they are values and not named `cache`. A closure
or attribute that is neither plain, an array nor a dataclass needs a recipe; without one, the class has none either.
"""

import functools
import inspect
import re
import threading
import types
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from typing import Any

import jax
import numpy as np

_PARSING = threading.Lock()  # of source: Python 3.11 raises a SystemError if several threads do
_PLAIN = (bool, int, float, complex, str, bytes)
_NAMED = (Enum, PurePath, range, slice, np.ufunc, np.dtype)  # known by their `repr`
_CODE = (re.Pattern, types.BuiltinFunctionType, types.ModuleType)
_CONSTANTS = (*_PLAIN, *_NAMED, *_CODE, np.ndarray, np.generic, jax.Array, tuple, list, dict, set, frozenset, type)
_INERT = ("typing", "types", "dataclasses")  # modules of annotations and markers, which compute nothing
_SLOTS = (types.MemberDescriptorType, types.GetSetDescriptorType)


def behavior_of(kind: type, recipe_of: Callable[[Any], Any], seen: tuple[int, ...] = ()) -> list[Any]:
    """The code of a class without its bases; `recipe_of` raises a TypeError for a part without a recipe."""
    attributes = [(name, part) for name, part in sorted(vars(kind).items()) if _counts(name, part)]
    parts = [[name, _part(part, recipe_of, (*seen, id(kind)))] for name, part in attributes]
    return [kind.__qualname__, _text(kind), parts]


def is_ours(kind: type) -> bool:
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
        code = [] if is_ours(type(part)) or id(type(part)) in seen else [behavior_of(type(part), recipe_of, seen)]
        return [type(part).__qualname__, *code, *parts(getattr(part, field.name) for field in fields(part))]
    return recipe_of(part)
