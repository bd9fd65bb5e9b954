"""Matches of a sequence: images -> features -> shortlist -> matches, kept in an archive, where that has a folder."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.validation import check_matching, checked_candidates, wrong_with
from mfvpr.features.extractor import Extractor, Source
from mfvpr.features.feature_set import FeatureSet
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.cohort_normalization import cohort_sequence
from mfvpr.reranking.results import Matched
from mfvpr.retrieval.fitting import fitted
from mfvpr.retrieval.retriever import Filter, Filtered
from mfvpr.storage.feature_cache import Archive
from mfvpr.storage.matches import MatchStore
from mfvpr.storage.shards import together
from mfvpr.types import Shortlist
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import placing, write_text
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.progress import Stopwatch

_REMARKS = "images.json"  # beside the matches: which images are bad
_SHORTLIST = "shortlist.npz"  # likewise, of shards


def match_sequence(
    dataset: Dataset,
    sequence: QuerySequence,
    extractor: Extractor | Source,
    filter: Filter,
    candidates: int | Literal["all"] = 50,
    *,
    matching: Matcher = NEIGHBORS,
    archive: Archive | None = None,
    watch: Stopwatch | None = None,
    rows: Sequence[int] | None = None,
    **where: Any,
) -> Matched:
    """Candidates and matches of one sequence's queries; features of no other database images than candidates are taken.

    Where the archive has a root, matches are kept below it, and where they are all there, nothing else is read.

    Args:
        dataset: of the sequence.
        sequence: Q queries.
        extractor: see `evaluate`.
        filter: see there.
        candidates: see there.
        matching: see there.
        archive: see there.
        watch: gets the seconds of the stages.
        rows: of the queries that are matched, and given; None = all. Of some, all are filtered, which decides whose
            features are taken.
        **where: `memory`, `devices` and `track` of `pipeline.match`.

    Raises:
        InputError: as `evaluate`.
        NotYet: of a shard, other ones have not taken their features.
    """
    check_matching(candidates, extractor, matching)
    if rows is not None and not all(0 <= row < len(sequence.images) for row in rows):
        raise InputError(f"rows: expected rows of {len(sequence.images)} queries, got {[*rows][:9]}")
    archive, watch, database = archive or Archive(), watch or Stopwatch(), dataset.database
    archive = archive if archive.watch else replace(archive, watch=watch)
    with watch("features"):
        extractor = fitted(extractor, database, archive)
    with watch("filter"):
        filter = fitted(filter, database, archive)
    num_candidates = _number(candidates, database)
    with ExitStack() as held:
        stores = []
        if archive.root is not None:
            recipe = matches_recipe(dataset, sequence, extractor, filter, candidates, matching, archive)
            stores = [held.enter_context(one) for one in _match_stores(sequence, extractor, recipe, archive)]
        weights = tuple(scale.weight for scale in extractor.scales)
        is_joint = rows is not None and archive.shard is not None and archive.shard.meets
        if kept := None if is_joint else _kept(sequence, stores, rows, archive, watch, where.get("memory")):
            kept = replace(kept, weights=weights)
            return kept if rows is not None else _looked_at(kept, archive)
        with watch("filter"):
            filtered = _filtered(sequence, database, filter, num_candidates, archive, stores)
        with watch("features"):
            sides, bad = _features(dataset, sequence, extractor, filtered, archive)
        _remark(stores, archive, bad)
        options = {"track": archive.track("matching"), **where}
        with watch("matching"):
            matches = tuple(
                stages.match(*scale, filtered.candidates, matching, store=store, rows=rows, **options)
                for scale, store in zip(sides, stores or [None] * len(sides), strict=True)
            )
    given = filtered.candidates if rows is None else jax.tree.map(lambda of: of[rows], filtered.candidates)
    matched = Matched(sequence, given, matches, bad["queries"], bad["database"], weights)
    return matched if rows is not None else _looked_at(matched, archive)


def _filtered(
    sequence: QuerySequence, database: ImageFolder, filter: Filter, num_candidates: int, archive: Archive,
    stores: Sequence[MatchStore],
) -> Filtered:  # fmt: skip
    """The shortlist; of shards, what the first of them found: on another machine near ties may come out otherwise."""

    def found() -> Filtered:
        sizes = len(sequence.images), len(database), num_candidates
        shortlist = filter.shortlist(sequence, database, num_candidates, archive)
        return checked_candidates(shortlist, type(filter).__name__, *sizes)

    if archive.shard is None:
        return found()
    path, about = stores[0].folder / _SHORTLIST, stores[0].folder.name
    if archive.shard.meets or not path.exists():
        candidates, *bad = found()
        arrays = {"indices": candidates.indices, "scores": candidates.scores, "bad": np.array(json.dumps(bad))}
        with placing(path) as temporary:
            write_arrays(temporary, arrays, about)
    kept = read_arrays(path, about)
    bad = [{int(row): reason for row, reason in side.items()} for side in json.loads(str(kept["bad"]))]
    return Filtered(Shortlist(kept["indices"], kept["scores"], kept["indices"] >= 0), *bad)


def match_cohort(
    dataset: Dataset,
    neighbors: int,
    extractor: Extractor | Source,
    filter: Filter,
    candidates: int | Literal["all"] = 50,
    *,
    archive: Archive | None = None,
    **how: Any,
) -> Matched:
    """Candidates and matches of the database images among each other, once for all sequences.

    See `mfvpr.reranking.cohort_normalization`.

    Args:
        dataset: whose database, in the order of the drive.
        neighbors: frames on both sides of an image that show its place, and are none of its candidates.
        extractor: see `evaluate`; and for all others `match_sequence`, which keeps the matches.
        filter: see there.
        candidates: see there.
        archive: see there.
        **how: see there.
    """
    archive = archive or Archive()
    sequence = cohort_sequence(archive.contents(dataset.database), neighbors)
    how = {"track": archive.track("cohort matching")} | how
    return match_sequence(dataset, sequence, extractor, filter, candidates, archive=archive, **how)


def _features(
    dataset: Dataset, sequence: QuerySequence, extractor: Extractor | Source, filtered: Filtered, archive: Archive
) -> tuple[list[tuple[FeatureSet, FeatureSet]], dict[str, Any]]:
    """By scale, those of the queries and of all candidates; and what is wrong with some images of either side."""
    rows = np.unique(filtered.candidates.indices[filtered.candidates.mask])
    database, queries = together(
        partial(archive.local, dataset.database, extractor, rows.tolist(), label="database"),
        partial(archive.local, sequence.images, extractor, label=f"query {sequence.name}"),
    )
    bad = {
        "queries": _by_row(filtered.bad_queries, queries[0].bad),
        "database": _by_row(filtered.bad_database, database[0].bad),
    }
    warnings = [
        *wrong_with(dataset.database, database[0], bad["database"]),
        *wrong_with(sequence.images, queries[0], bad["queries"]),
    ]
    return list(zip(queries, database, strict=True)), bad | {"warnings": warnings}


def _looked_at(matched: Matched, archive: Archive) -> Matched:
    """The same; queries that the filter finds nothing for are told."""
    nothing = [row for row in np.flatnonzero(~matched.candidates.mask.any(axis=1)) if row not in matched.bad_queries]
    if nothing:
        images = matched.sequence.images
        archive.warn(f"{images.paths[nothing[0]]}: no candidates ({len(nothing)} such queries of {len(images)}), which "
                     "counts as a failure")  # fmt: skip
    return matched


def _number(candidates: int | Literal["all"], database: ImageFolder) -> int:
    return len(database) if candidates == "all" else min(int(candidates), len(database))


def _by_row(*reasons: Mapping[int, str]) -> dict[int, str]:
    return {int(row): reason for some in reasons for row, reason in some.items()}


def _kept(
    sequence: QuerySequence, stores: Sequence[MatchStore], rows: Sequence[int] | None, archive: Archive,
    watch: Stopwatch, memory: float | None,
) -> Matched | None:  # fmt: skip
    """Matches of all scales, of stores that have them all."""
    asked = slice(None) if rows is None else [*rows]
    if not stores or not asked or not all(store.done[asked].all() for store in stores):
        return None
    try:
        remarks = json.loads((stores[0].folder / _REMARKS).read_text())
        bad = [{int(row): reason for row, reason in remarks[side].items()} for side in ("queries", "database")]
        warnings = [*remarks["warnings"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None  # so images are looked at again, but not matched
    with watch("matches read"):
        read = [stages.stored_matches(store, rows, memory=memory) for store in stores]
    if any((other.indices != read[0][1].indices).any() for _, other in read):
        return None  # another shortlist for some scales, which will be told
    for line in warnings:
        archive.warn(line)
    queries, database = bad
    return Matched(sequence, read[0][1], tuple(match_set for match_set, _ in read), queries, database)


def _remark(stores: Sequence[MatchStore], archive: Archive, remarks: Mapping[str, Any]) -> None:
    """Tell what is wrong with images, also to those who will read the matches and nothing else."""
    for store in stores[:1]:
        write_text(store.folder / _REMARKS, json.dumps(remarks))
    for line in remarks["warnings"]:
        archive.warn(line)


def matches_recipe(
    dataset: Dataset, sequence: QuerySequence, extractor: Extractor | Source, filter: Filter,
    candidates: int | Literal["all"], matching: Matcher, archive: Archive,
) -> dict[str, Any]:  # fmt: skip
    """All that changes a shortlist and its matches: both sides' images and features, the filter, and the matching."""
    excluded, database = sequence.excluded, dataset.database
    extractor, filter = fitted(extractor, database, archive), fitted(filter, database, archive)
    return {
        "database": archive.recipe(database, extractor),
        "query": archive.recipe(sequence.images, extractor),
        "filter": archive.recipe_of(filter),
        "candidates": _number(candidates, database),
        "matching": archive.recipe_of(matching),
        "skip_bad": archive.skip_bad,
        "excluded": None if excluded is None else recipe_of([excluded.rows, excluded.offsets]),
    }


def _match_stores(
    sequence: QuerySequence, extractor: Extractor | Source, recipe: Mapping[str, Any], archive: Archive
) -> Iterator[AbstractContextManager[MatchStore]]:
    """A store for the matches of each scale."""
    several = len(extractor.scales) > 1
    share = 1 if recipe["matching"].get("cross_check") in ("none", "candidate") else 3
    for number, scale in enumerate(extractor.scales):
        yield archive.matches(
            {**recipe, "scale": number} if several else recipe, sequence.images.names, recipe["candidates"],
            typical=scale.typical_count // share, label=f"{sequence.name} matches",
        )  # fmt: skip
