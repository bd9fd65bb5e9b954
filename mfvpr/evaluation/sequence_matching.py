"""Matches of a sequence: images -> features -> shortlist -> matches, kept in the folder of a cache, if any."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.rankings import Matched
from mfvpr.evaluation.system import Pipeline, folders_of
from mfvpr.matchers.host_matcher import Side
from mfvpr.retrieval.retriever import RetrievalResult, fit_to_database
from mfvpr.storage.cache_files import MatchStore
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.runtime import Runtime, Stopwatch

_REMARKS = "images.json"  # beside the matches: which images are bad


def match_sequence(
    dataset: Dataset,
    sequence: QuerySequence,
    pipeline: Pipeline,
    *,
    cache: FeatureCache | None = None,
    runtime: Runtime | None = None,
    watch: Stopwatch | None = None,
) -> Matched:
    """Find and match the candidates of one sequence's queries; features of other database images are not extracted.

    If the cache has a root, matches are kept below it. If they are all there, nothing else is read. `watch` gets the
    seconds of the stages; the other arguments and the errors are those of `mfvpr.evaluate`.
    """
    cache, watch, database = cache or FeatureCache(), watch or Stopwatch(), dataset.database
    cache = replace(cache, runtime=runtime or cache.runtime, watch=cache.watch or watch)
    if pipeline.pixels is not None:
        pipeline = pipeline.with_image_size(pipeline.size_for_images(folders_of(dataset), cache.warn))
    if pipeline.image_source is None:
        with watch("features"):
            pipeline = replace(pipeline, extractor=fit_to_database(pipeline.extractor, database, cache))
    with watch("retrieval"):
        retriever = fit_to_database(pipeline.retriever, database, cache)
        pipeline = replace(pipeline, retriever=retriever)
    number, stores = num_candidates(pipeline.candidates, database), list[MatchStore]()
    recipe = cache.recipe(lambda: matches_recipe(dataset, sequence, pipeline, cache))
    if recipe is not None and cache.root is not None:
        scales = range(len(pipeline.scales))
        stores = [MatchStore(cache.root, recipe | {"scale": scale}, len(sequence.images)) for scale in scales]
    matched = _read_matches(sequence, number, stores, cache, watch)
    if matched is None:
        with watch("retrieval"):
            retrieved = retriever.shortlist(sequence, database, number, cache)
            retrieved = _check_candidates(retrieved, type(retriever).__name__, (len(sequence.images), number), database)
        with watch("features"):
            sides, remarks = _extract(dataset, sequence, pipeline, retrieved, cache)
        for store in stores[:1]:  # for later runs, which read the matches and nothing else
            write_text(store.folder / _REMARKS, json.dumps(remarks))
        for line in remarks["warnings"]:
            cache.warn(line)
        with watch("matching"):
            matches = tuple(
                stages.match(*scale, retrieved.candidates, pipeline.matcher, store=store, runtime=cache.runtime)
                for scale, store in zip(sides, stores or [None] * len(sides), strict=True)
            )
        matched = Matched(sequence, retrieved.candidates, matches, remarks["queries"], remarks["database"])
    there = matched.candidates.mask
    empty = int((there & (matched.matches[0].counts == 0)).sum())
    if pipeline.image_source is not None and empty and 2 * empty >= there.sum():
        cache.warn(f"{sequence.name}: {empty} of {there.sum()} pairs have no matches; they score 0")
    missing = [row for row in np.flatnonzero(~there.any(axis=1)) if row not in matched.bad_queries]
    if missing:
        queries = f"{len(missing)} such queries of {len(sequence.images)}"
        cache.warn(f"{sequence.images.paths[missing[0]]}: no candidates ({queries}), which counts as a failure")
    return replace(matched, weights=tuple(scale.weight for scale in pipeline.scales))


def num_candidates(candidates: int | Literal["all"], database: ImageFolder) -> int:
    """Candidates of a query: as many as the setting says, if the database has so many images."""
    return len(database) if candidates == "all" else min(int(candidates), len(database))


def matches_recipe(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, cache: FeatureCache
) -> dict[str, Any]:
    """JSON values that determine a shortlist and its matches: images and features, retrieval, and matcher."""
    excluded, database = sequence.excluded, dataset.database
    extractor = None
    if pipeline.image_source is None:
        extractor = fit_to_database(pipeline.extractor, database, cache)
    return {
        "database": cache.recipes.of_folder(database, extractor),
        "query": cache.recipes.of_folder(sequence.images, extractor),
        "filter": cache.recipes.of(fit_to_database(pipeline.retriever, database, cache)),
        "candidates": num_candidates(pipeline.candidates, database),
        "matching": cache.recipes.of(pipeline.matcher),
        "skip_bad": cache.skip_bad,
        "excluded": None if excluded is None else recipe_of([excluded.rows, excluded.offsets]),
    }


def _read_matches(
    sequence: QuerySequence, depth: int, stores: Sequence[MatchStore], cache: FeatureCache, watch: Stopwatch
) -> Matched | None:
    """Matches of all scales from the stores, with `depth` candidates; None if some are missing."""
    if not stores:
        return None
    number = len(sequence.images)
    is_done = all(store.is_complete for store in stores)
    line = f"all {number} queries from" if is_done else f"{number} queries with {depth} candidates, in"
    cache.runtime.log(f"{sequence.name} matches: {line} {stores[0].folder}")
    if not is_done:
        return None
    try:
        remarks = json.loads((stores[0].folder / _REMARKS).read_text())
        queries, database, warnings = _by_row(remarks["queries"]), _by_row(remarks["database"]), [*remarks["warnings"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None  # so images are read again, but not matched
    with watch("matches read"):
        scales = [scale for store in stores if (scale := stages.stored_matches(store, memory=cache.runtime.memory))]
    if len(scales) < len(stores):
        cache.warn(f"{stores[0].folder}: has damaged files; their queries are matched again")
        return None
    match_sets, shortlists = zip(*scales, strict=True)
    if any((shortlist.indices != shortlists[0].indices).any() for shortlist in shortlists):
        return None  # scales with different shortlists: matching will raise
    for line in warnings:
        cache.warn(line)
    return Matched(sequence, shortlists[0], match_sets, queries, database)


def _by_row(*reasons: Mapping[Any, str]) -> dict[int, str]:
    return {int(row): reason for side in reasons for row, reason in side.items()}


def _extract(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, retrieved: RetrievalResult, cache: FeatureCache
) -> tuple[list[tuple[Side, Side]], dict[str, Any]]:
    """Features of the queries and of all candidates by scale, or their images, and remarks on bad images."""
    extractor, candidates = pipeline.extractor, retrieved.candidates
    if (source := pipeline.image_source) is not None:
        sides = sequence.images, dataset.database
        remarks = {"queries": retrieved.bad_queries, "database": retrieved.bad_database}
        return [sides], {**remarks, "warnings": source.open(*sides).warnings(candidates)}
    rows = np.unique(candidates.indices[candidates.mask]).tolist()
    database = cache.local(dataset.database, extractor, rows, label="database")
    queries = cache.local(sequence.images, extractor, label=f"query {sequence.name}")
    bad_queries = _by_row(retrieved.bad_queries, queries[0].bad)
    bad_database = _by_row(retrieved.bad_database, database[0].bad)
    warnings = list[str]()
    parts = (dataset.database, database[0], bad_database), (sequence.images, queries[0], bad_queries)
    for folder, features, bad in parts:
        warnings += bad.values()
        empty = [row for row in np.flatnonzero(features.source.counts == 0).tolist() if row not in bad]
        if empty:
            words = f"no keypoints, so no matches ({len(empty)} such images of {len(folder)}); scores are 0"
            warnings.append(f"{folder.paths[empty[0]]}: {words}")
    remarks = {"queries": bad_queries, "database": bad_database, "warnings": warnings}
    return list(zip(queries, database, strict=True)), remarks


def _check_candidates(retrieved: Any, name: str, shape: tuple[int, int], database: ImageFolder) -> RetrievalResult:
    """Check the candidates of the retrieval `name`, which may be user-defined; return them padded with -1 and 0."""
    if not (isinstance(retrieved, RetrievalResult) and isinstance(retrieved.candidates, Shortlist)):
        raise InputError(f"{name}: expected RetrievalResult(shortlist, {{}}, {{}}), got {type(retrieved).__name__}")
    shortlist = retrieved.candidates
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    if {indices.shape, scores.shape, mask.shape} != {shape} or mask.dtype != bool or indices.dtype.kind not in "iu":
        shapes = f"{list(indices.shape)}, {list(scores.shape)} and {list(mask.shape)}"
        parts = f"indices (whole), scores and mask (bool) of {list(shape)} each"
        raise InputError(f"{name}: expected {parts}, got {shapes}; pad with -1")
    if not ((indices[mask] >= 0) & (indices[mask] < len(database))).all():
        got = f"{indices[mask].min()} to {indices[mask].max()}"
        raise InputError(f"{name}: expected rows of the database from 0 to {len(database) - 1}, got {got}")
    ordered = np.sort(np.where(mask, indices, -1), axis=1)
    if (is_repeated := (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        query, place = np.argwhere(is_repeated)[0]
        got = f"{ordered[query, place]} twice for query {query}"
        raise InputError(f"{name}: expected every row of the database once, got {got}")
    if not np.isfinite(scores[mask]).all():
        raise InputError(f"{name}: expected finite scores")
    indices, scores = np.where(mask, indices, -1).astype(np.int32), np.where(mask, scores, 0).astype(np.float32)
    return retrieved._replace(candidates=Shortlist(indices, scores, mask))
