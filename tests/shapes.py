"""Checks annotated shapes at every call; pytest loads this module before the library (`-p` in pyproject.toml)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from jaxtyping import config, install_import_hook


def check_shapes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check annotations of arrays at every call, and leave other types to pyright."""
    from beartype import beartype

    function.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if _is_array(hint)}
    return beartype(function)


def _is_array(hint: object) -> bool:
    return "jaxtyping" in repr(hint)


@contextmanager
def unchecked_shapes() -> Iterator[None]:
    """Let wrong shapes pass, for tests of what the library says of them."""
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", False)


if find_spec("beartype"):
    install_import_hook("mfvpr", f"{__name__}.{check_shapes.__name__}")
