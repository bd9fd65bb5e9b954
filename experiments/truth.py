"""What a recall refers to: which ground truth, what still counts as right, and how that is written."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.settings import SettingsError
from mfvpr import evaluation
from mfvpr.datasets import Dataset, Truth
from mfvpr.evaluation import Judge
from mfvpr.utils import fingerprints

_FILES = ("index_file", "query_labels", "database_labels")
_WORDS = {"order": "file order", "utm": "positions in the names", "drawn": "drawn with the images",
          "published": "as published"}  # fmt: skip


def thresholds(settings: Mapping[str, Any], truth: Truth | None) -> list[float]:
    """What counts as right, in the unit of the ground truth, ascending; none without ground truth."""
    recall = settings["recall"]
    return [] if truth is None else truth.thresholds(tolerances=recall["tolerances"], radius=recall["radius"])


def judge(settings: Mapping[str, Any], dataset: Dataset) -> Judge:
    """What a search or a learning judges rankings by."""
    if dataset.truth is None:
        raise SettingsError(
            "dataset.ground_truth=none: choosing settings needs a ground truth; set order, index, utm or label"
        )
    return evaluation.judge(dataset.truth, thresholds(settings, dataset.truth), settings["split"])


def described(settings: Mapping[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Kind, files, unit and thresholds of the ground truth, as results keep them."""
    chosen, truth = settings["dataset"], dataset.sequences[0].truth
    known = "drawn" if "cache" in chosen else "published"
    kind = {"kind": chosen.get("ground_truth", known), "files": [chosen[name] for name in _FILES if chosen.get(name)]}
    kind["exclude_neighbors"] = chosen.get("exclude_neighbors")
    return kind if truth is None else kind | {"unit": truth.unit, "thresholds": thresholds(settings, truth)}


def fingerprint(dataset: Dataset, thresholds: Sequence[float]) -> str | None:
    """Of what is right at these thresholds, in every sequence, whatever file says it; None without ground truth."""
    known = [
        [sequence.name, *(sequence.truth.positives(threshold) for threshold in thresholds)]
        for sequence in dataset.sequences
        if sequence.truth is not None
    ]
    if not known:
        return None
    rows = [[name, *({"rows": one.rows, "offsets": one.offsets} for one in found)] for name, *found in known]
    return fingerprints.fingerprint(fingerprints.recipe_of(rows))


def in_words(*described: Mapping[str, Any]) -> str:
    """The same for a heading, of data sets whose thresholds are one."""
    first = described[0]
    if "unit" not in first:
        return "no ground truth: rankings only"
    source = ", ".join(dict.fromkeys(map(_source, described)))
    if first["unit"] == "exact":
        return f"recall in %, ground truth: {source}"
    within = ", ".join(f"{threshold:g}" for threshold in first["thresholds"])
    return f"recall in %, within {within} {first['unit']} of the ground truth: {source}"


def _source(described: Mapping[str, Any]) -> str:
    kind, files = described["kind"], ", ".join(dict.fromkeys(described["files"]))
    return ("labels in " if kind == "label" else "") + (files or _WORDS.get(kind, kind))
