"""Options of a scorer that are one of a few words."""

from dataclasses import field, fields
from typing import Any


def choice(default: str, *others: str) -> Any:
    """A static dataclass field that holds one of the words given, the first by default."""
    return field(default=default, metadata={"static": True, "choices": (default, *others)})


def check_choices(scorer: Any) -> None:
    """Raise a ValueError that names the field whose word is none of its choices."""
    for one in fields(scorer):
        choices, value = one.metadata.get("choices"), getattr(scorer, one.name)
        if choices and value not in choices:
            raise ValueError(f"{type(scorer).__name__}({one.name}={value!r}): expected one of {', '.join(choices)}")
