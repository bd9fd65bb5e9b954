"""What the methods of a class do, as far as they say it themselves: so that changed code is not taken for the old.

It is what runs that counts (instructions, constants, names, defaults, and what a function closes over), and the text
of the class where there is one: a file may have been edited since it was read. What methods call is not looked at.
Class attributes count as well. Private attributes count if they hold values and no name says `cache`.
"""

import functools
import inspect
from collections.abc import Callable
from types import CodeType, FunctionType
from typing import Any

import jax
import numpy as np

_PLAIN = (bool, int, float, complex, str, bytes)
_CONSTANTS = (*_PLAIN, np.ndarray, np.generic, jax.Array, tuple, list, dict, set, frozenset, type)


def behavior_of(kind: type, recipe_of: Callable[[Any], Any]) -> list[Any]:
    """In JSON's terms.

    Args:
        kind: a class, without its bases.
        recipe_of: what stands for an array.
    """
    parts = [[name, _part(part, recipe_of, ())] for name, part in sorted(vars(kind).items()) if _counts(name, part)]
    return [kind.__qualname__, _text(kind), parts]


def _text(kind: type) -> str:
    try:
        return inspect.getsource(kind)
    except (OSError, TypeError):  # typed into a terminal, or made by a program
        return ""


def _counts(name: str, part: Any) -> bool:
    """Functions and attributes, except Python's notes (`__doc__`), and private caches and objects."""
    if _functions(part) or isinstance(part, functools.partial) or not name.startswith("_"):
        return True
    is_note = name.startswith("__") and name.endswith("__")
    return isinstance(part, _CONSTANTS) and not is_note and "cache" not in name.lower()


def _functions(part: Any) -> list[Any]:
    """Those of a method, a property, or of what wraps one."""
    if isinstance(part, property):
        return [function for function in (part.fget, part.fset, part.fdel) if function is not None]
    inner = getattr(part, "func", None) if isinstance(part, functools.cached_property) else None
    inner = inner or getattr(part, "__wrapped__", None) or getattr(part, "__func__", None)
    return [part] if isinstance(part, FunctionType) and inner is None else [inner] if inner is not None else []


def _part(part: Any, recipe_of: Callable[[Any], Any], seen: tuple[int, ...]) -> Any:
    if id(part) in seen:  # a function that closes over itself
        return "itself"
    seen = (*seen, id(part))
    if isinstance(part, FunctionType):
        closure = [cell.cell_contents for cell in part.__closure__ or () if _is_filled(cell)]
        held = [part.__defaults__ or (), part.__kwdefaults__ or {}, *closure]
        return [_part(value, recipe_of, seen) for value in (part.__code__, *held)]
    if isinstance(part, CodeType):
        constants = [_part(value, recipe_of, seen) for value in part.co_consts]
        return [part.co_code.hex(), list(part.co_names), list(part.co_varnames), constants]
    if isinstance(part, functools.partial):
        return [_part(value, recipe_of, seen) for value in (part.func, part.args, part.keywords)]
    if functions := _functions(part):
        return [_part(function, recipe_of, seen) for function in functions]
    if isinstance(part, tuple | list):
        return [_part(value, recipe_of, seen) for value in part]
    if isinstance(part, dict):
        return [[str(name), _part(value, recipe_of, seen)] for name, value in part.items()]
    if isinstance(part, set | frozenset):
        return sorted(map(repr, part)) if all(isinstance(value, _PLAIN) for value in part) else type(part).__qualname__
    if part is None or isinstance(part, _PLAIN):
        return [type(part).__qualname__, repr(part)]
    if isinstance(part, np.ndarray | np.generic | jax.Array):
        return recipe_of(part)
    return part.__qualname__ if isinstance(part, type) else type(part).__qualname__


def _is_filled(cell: Any) -> bool:
    try:
        _ = cell.cell_contents
    except ValueError:  # not yet
        return False
    return True
