"""The library's messages in words of the settings: it knows its own parameters, a user of the programs what was set."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from experiments.settings import SettingsError

_FILES = "(index_file|database_labels|query_labels)"
# What is a setting in the library's words, and how it is set. GROUP is the group whose file the message is about.
WORDS = {
    r"or skip bad images$": "or set on_bad_image=skip",
    rf"give {_FILES} as well": r"give dataset.\1=FILE as well",
    rf"given as {_FILES}, but ground_truth=": r"given as dataset.\1, but dataset.ground_truth=",
    r"^(ground_truth|exclude_neighbors|queries)(=|:)": r"dataset.\1\2",
    r"(expected one query sequence, got \d+); choose one of ": r"\1; give one folder as dataset.queries=[DIR], of ",
    r"give names with their folders as the file has them": "say what stands before the names in the file with "
    "GROUP.database_prefix=... and GROUP.query_prefix=...",
    r"called by their paths below their folder\)": "called by their paths below their folder, behind "
    "GROUP.database_prefix and GROUP.query_prefix)",
    r"give one of this folder as well$": "choose another retrieval, or no cohort",  # others are asked for all folders
    r"or lower num_words$": "or lower retrieval.num_words",
    r"extract these, or match nearest neighbors$": "set features=aliked, or matching=neighbors",
    r"give it as image_size=$": "give it as features.image_size=[W,H]",
    r"lengths='(normalize|keep)'": r"GROUP.lengths=\1",
    r"^weights: expected": "fusion.weights: expected",
    r"score by it as well$": "choose scorer=all, or another group of scores that has it",
}


@contextmanager
def in_settings(settings: Mapping[str, Any]) -> Iterator[None]:
    """What the library refuses, told in words of the settings."""
    from mfvpr.utils import InputError

    try:
        yield
    except InputError as error:
        if (text := _translated(str(error), settings)) == str(error):
            raise
        raise SettingsError(text) from error


def _translated(text: str, settings: Mapping[str, Any]) -> str:
    own = _group(text, settings)
    for words, ours in WORDS.items():
        text = re.sub(words, ours.replace("GROUP", own), text)
    return text


def _group(text: str, settings: Mapping[str, Any]) -> str:
    """Whose file a message begins with."""
    from experiments.build import expanded

    retrieval = settings.get("retrieval", {})
    queries = retrieval.get("queries", [])
    files = [retrieval.get("database"), *(queries if isinstance(queries, list) else [queries])]
    return "retrieval" if any(file and text.startswith(f"{expanded(file)}:") for file in files) else "features"
