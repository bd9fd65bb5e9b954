"""The text of `--help`: the files of conf/ with their comments, for the chosen groups."""

import itertools
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from mfvpr.cli.groups import aliked_or_sift, check_choice, choices, defaults, groups
from mfvpr.systems.settings import CONF

_WHOLE = ("system", "experiment")  # groups that set values of all other groups
_SECTIONS = {"launcher": "hydra"}  # the section of a group's settings, if it has another name than the group


def help_text(config: str, arguments: Sequence[str]) -> str:
    """Usage of a program, its groups, and its settings with the choices among the arguments."""
    typed = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    for name in filter(choices, typed):
        check_choice(name, typed[name], config)
    chosen = groups(config)
    typed = {group: choice for group, choice in typed.items() if group in chosen}
    chosen |= {group: typed[group] for group in _WHOLE if group in typed}
    chosen |= _overrides(chosen) | typed
    for group, choice in chosen.items():
        if choice and choice.startswith("${"):
            other = aliked_or_sift(lambda line: None) if choice.endswith(":}") else chosen[choice[2:-1]]
            chosen[group] = other if other in choices(group) else None
    return "\n".join([*_parts(config, chosen)])


def _parts(config: str, chosen: dict[str, str | None]) -> Iterator[str]:
    yield from (line.removeprefix("#").removeprefix(" ") for line in _header(CONF / f"{config}.yaml"))
    if chosen:
        yield "\nGroups, each with the choice whose settings follow, and other choices:\n"
    for group, choice in chosen.items():
        label, rest = f"  {group}={choice or 'null'}".ljust(26), [name for name in choices(group) if name != choice]
        yield textwrap.fill(", ".join(rest), 110, initial_indent=label, subsequent_indent=" " * 26) or label
    yield "\nSettings:\n"
    for group, choice in chosen.items():
        if choice and group not in _WHOLE:
            yield from [*_section(_SECTIONS.get(group, group), _merge(CONF / group / f"{choice}.yaml")), ""]
    for file in (*(entry for entry in defaults(CONF / f"{config}.yaml") if _is_file(entry)), config):
        yield from [*_body(CONF / f"{file}.yaml"), ""]
    for group in _WHOLE:
        if choice := chosen.get(group):
            file = CONF / group / f"{choice}.yaml"
            yield from [f"# {group}={choice}, over the settings above:", *_header(file), *_body(file), ""]


def _overrides(chosen: dict[str, str | None]) -> dict[str, str]:
    """The choices that a system or an experiment makes in other groups."""
    return {
        name.removeprefix("override /"): choice
        for group in _WHOLE
        if chosen.get(group)
        for entry in defaults(CONF / group / f"{chosen[group]}.yaml")
        for name, choice in entry.items()
    }


def _section(name: str, lines: Iterable[str]) -> list[str]:
    return [f"{name}:", *textwrap.indent("\n".join(lines), "  ").splitlines()]


def _merge(file: Path) -> list[str]:
    """The lines of a choice and of its defaults, without the defaults that it replaces."""
    body, inherited = _body(file), []
    keys = {line.partition(":")[0] for line in body}
    for entry in defaults(file):
        if not _is_file(entry):
            continue
        other, _, place = entry.partition("@")
        lines = _merge(file.with_name(f"{other}.yaml"))
        lines = _section(place, lines) if place else lines
        inherited += [line for line in lines if line.startswith(("#", " ")) or line.partition(":")[0] not in keys]
    return [*_header(file), *inherited, *body]


def _is_file(entry: object) -> bool:
    return isinstance(entry, str) and entry != "_self_"


def _header(file: Path) -> list[str]:
    """The comment that a file begins with, without the lines for Hydra or for editors of the file."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), file.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if not line.startswith(("# @", "# Made by "))]


def _body(file: Path) -> list[str]:
    """A file's settings with their comments, without its header and the sections for Hydra."""
    text = re.sub(r"\A(?:#.*\n)*", "", file.read_text(encoding="utf-8"))
    text = re.sub(r"^(?:defaults|hydra):.*\n(?:[ -].*\n|\n)*", "", text, flags=re.MULTILINE)
    return text.strip("\n").splitlines()
