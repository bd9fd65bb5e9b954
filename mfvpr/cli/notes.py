"""Notes and warnings about the data of a program, before it begins."""

from collections.abc import Mapping, Sequence
from itertools import takewhile
from typing import Any

from mfvpr.baselines.learned_weight import provenance
from mfvpr.cli.console import tell
from mfvpr.cli.schema import Common
from mfvpr.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.datasets.contents import Contents, OwnRows, fingerprints, own_rows, readings
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.systems import assembly

# A learned match weight depends on these settings.
_LEARNED_WITH = {"features": ("name", "weights"), "matching": ("name", "cross_check")}


def tell_peculiarities(dataset: Dataset, contents: Mapping[str, Contents], thresholds: Sequence[float]) -> None:
    """Tell what is peculiar about the images and the ground truth."""
    for difference in published_differences(dataset):
        tell(f"warning: {dataset.name}: {difference}; its numbers are not comparable")
    database, *queries = contents.values()
    for sequence, images in zip(dataset.sequences, queries, strict=True):
        _warn_of_sequence(sequence, own_rows(images, database), thresholds)
    _warn_of_reading(contents, dataset.database.bits)


def _warn_of_sequence(sequence: QuerySequence, same_images: OwnRows, thresholds: Sequence[float]) -> None:
    """Warn of queries that are database images, and of thresholds without any correct prediction."""
    queries, same, excluded = len(same_images), sum(map(bool, same_images)), sequence.excluded
    if same and excluded is None:
        tell(f"warning: {same} of {queries} queries are database images themselves, so that each finds itself; set "
              "dataset.exclude_neighbors=N to leave out what is within N frames of it (0 = itself alone)")  # fmt: skip
    if excluded is not None and same < queries:
        tell(f"note: {queries - same} of {queries} queries are no database images; nothing is left out for them")
    if (ground_truth := sequence.truth) is None:
        return
    without = list(takewhile(lambda threshold: not ground_truth.positives(threshold).rows.size, thresholds))
    if without == thresholds:
        tell("warning: the ground truth has no correct image for any query; every recall will be 0")
    elif without:
        words = ", ".join(threshold_words(ground_truth.unit, threshold).strip() for threshold in without)
        remedy = "larger recall.tolerances" + ", or fewer dataset.exclude_neighbors" * (excluded is not None)
        tell(f"warning: no query has a correct image within {words}; recall will be 0 there; use {remedy}")


def _warn_of_reading(contents: Mapping[str, Contents], bits: int | None) -> None:
    """Note conversions of the images, and warn of 16-bit images whose range does not fit."""
    by_side = readings(contents)
    for side, reading in by_side.items():
        if reading["turned"]:
            tell(f"note: {reading['turned']} {side} images are turned as their EXIF orientation says")
        if reading["scaled_16bit"]:
            tell(f"note: {reading['scaled_16bit']} 16-bit {side} images are scaled to 8 bits")
    largest = max(reading["largest_16bit"] or 0 for reading in by_side.values())
    used = max(largest.bit_length(), 8)
    if largest and bits is not None and not bits - 1 <= used <= bits:
        look = "dark" if used < bits else "cut off"
        tell(f"warning: the largest value of all 16-bit images is {largest}, so that they come out {look}; "
              f"dataset.bits={used} would use their range")  # fmt: skip


def note_candidates(candidates: Any, ks: Sequence[int], database: ImageFolder) -> None:
    """Note that fewer candidates are available than `candidates` or `recall.ks` expect."""
    available = num_candidates(candidates, database)
    if isinstance(candidates, int) and candidates > available:
        tell(f"note: candidates={candidates}, but the database has {available} images; all of them are re-ranked")
    if deeper := [f"R@{k}" for k in ks if k > available]:
        verb = "is" if len(deeper) == 1 else "are"
        tell(f"note: {' and '.join(deeper)} {verb} R@{available}, of retrieval too: no more candidates are looked at")


def warn_of_matching(settings: Common, dataset: str, contents: Mapping[str, Contents]) -> None:
    """Warn of features that LightGlue may not know, and of match weights that do not fit."""
    if settings.features["name"] == "import" and settings.matching["name"] == "lightglue":
        tell("warning: matching=lightglue knows ALIKED's features alone; what features=import gives must be these")
    names = {values.get("weight", "fs") for values in assembly.expand_weights(settings.scorer).values()}
    names |= {*(getattr(settings, "grid", {}).get("weight") or ())}  # that a sweep tries
    groups = {"features": settings.features, "matching": settings.matching}
    for name in sorted(names):
        _warn_of_weight(name, groups, dataset, {*fingerprints(contents).values()})


def _warn_of_weight(name: str, settings: Mapping[str, Any], dataset: str, images: set[str]) -> None:
    """Warn of a match weight that was learned on these images, or with other features or matches."""
    if not (origin := provenance(name)):
        return
    learned_on = {
        folder for each in origin.get("data_sets", [origin]) for folder in each.get("data_fingerprint", {}).values()
    }
    if images & learned_on:
        tell(f"warning: weight={name} was learned on images of {dataset}, so that it flatters here")
    for group, keys in _LEARNED_WITH.items():
        before, now = origin.get("settings", {}).get(group, {}), settings[group]
        if other := [key for key in keys if before.get(key) != now.get(key)]:
            words = ", ".join(f"{before.get(key, 'unknown')} instead of {now.get(key)}" for key in other)
            tell(f"warning: weight={name} was learned with other {group} ({words}); it may mean nothing here")
