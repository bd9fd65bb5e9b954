"""Translate errors of the library, which name its parameters, into errors that name settings."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mfvpr.systems.settings import SettingsError

# Pattern in a message of the library -> words of the settings. GROUP stands for `features` or `retrieval`.
_WORDS = {
    r"or skip bad images$": "or set on_bad_image=skip",
    r"^(ground_truth|exclude_neighbors|queries)(=|:)": r"dataset.\1\2",
    r"(expected one query sequence, got \d+); choose one of ": r"\1; give one folder as dataset.queries=[DIR], of ",
    r"give names with their folders as the file has them": "say what stands before the names in the file with "
    "GROUP.database_prefix=... and GROUP.query_prefix=...",
    r"names are paths below the folder\)": "names are paths below the folder, behind "
    "GROUP.database_prefix and GROUP.query_prefix)",
    r"give one of this folder as well$": "choose another retrieval, or no cohort",  # not for one of several folders
    r"or lower num_words$": "or lower retrieval.num_words",
    r"extract these, or match nearest neighbors$": "set features=aliked, or matching=neighbors",
    r"give it as image_size=$": "give it as features.image_size=[W,H]",
    r"lengths='(normalize|keep)'": r"GROUP.lengths=\1",
    r"^weights: expected": "fusion.weights: expected",
    r"score by it as well$": "choose scorer=all, or another group of scores that has it",
}


@contextmanager
def in_settings(retrieval: Mapping[str, Any]) -> Iterator[None]:
    """Raise errors of the library again, in words of the settings; those of the retrieval may name its files."""
    from mfvpr.utils import InputError

    try:
        yield
    except InputError as error:
        text, group = str(error), _group(str(error), retrieval)
        for pattern, words in _WORDS.items():
            text = re.sub(pattern, words.replace("GROUP", group), text)
        if text == str(error):
            raise
        raise SettingsError(text) from error


def _group(text: str, retrieval: Mapping[str, Any]) -> str:
    """The group of settings with the file that a message begins with."""
    from mfvpr.cli.build import expand_user

    queries = retrieval.get("queries", [])
    files = [retrieval.get("database"), *(queries if isinstance(queries, list) else [queries])]
    return "retrieval" if any(file and text.startswith(f"{expand_user(file)}:") for file in files) else "features"
