"""Translate errors of the library, which name its parameters, into errors that name settings."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mfvpr.systems.settings import SettingsError

# Pattern in a message of the library -> words of the settings. GROUP stands for `features`, `retrieval` or `matching`.
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
    r"give it as image_size=$": "give it as GROUP.image_size=[W,H]",
    r"set image_size=\[W,H\]$": "set matching.image_size=[W,H]",
    r"confidences=False": "matching.confidences=false",
    r"verified=True": "matching.verified=true",
    r"give hloc's feats\*.h5$": "set matching.features=FILE, hloc's feats*.h5",
    r"the prefix(?:es)? of (both folders|their folder)": "matching.database_prefix and "
    r"matching.query_prefix, the prefixes of \1",
    r"match them with_ratio=True$": "set another weight, such as scorer.weight=unit, for matching=import",
    r"lengths='(normalize|keep)'": r"GROUP.lengths=\1",
    r"^weights: expected": "fusion.weights: expected",
    r"score by it as well$": "choose scorer=all, or another group of scores that has it",
}


@contextmanager
def in_settings(settings: Mapping[str, Any]) -> Iterator[None]:
    """Raise errors of the library again, in words of the settings, which may name files of other programs."""
    from mfvpr.utils import InputError

    try:
        yield
    except InputError as error:
        text, group = str(error), _group(str(error), settings)
        for pattern, words in _WORDS.items():
            text = re.sub(pattern, words.replace("GROUP", group), text)
        if text == str(error):
            raise
        raise SettingsError(text) from error


def _group(text: str, settings: Mapping[str, Any]) -> str:
    """The group of settings with the file that a message begins with."""
    from mfvpr.cli.build import expand_user

    for group in ("retrieval", "matching"):
        values = settings.get(group, {})
        for name in ("database", "queries", "matches", "features", "query_features"):
            files = values.get(name) or []
            for file in files if isinstance(files, list) else [files]:
                if text.startswith(f"{expand_user(file)}:"):
                    return group
    return "features"
