"""Matches of a sequence: images -> features -> shortlist -> matches, kept in the folder of a cache, if any."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.system import Pipeline
from mfvpr.evaluation.validation import image_warnings, validate_candidates
from mfvpr.features.extractor import Extractor, Source
from mfvpr.features.feature_set import FeatureSet
from mfvpr.reranking.results import Matched
from mfvpr.retrieval.fitting import fit_to_database
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.matches import MatchStore
from mfvpr.storage.shards import NotYet, together
from mfvpr.types import Shortlist
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.files import replacing, write_text
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.progress import Stopwatch
from mfvpr.utils.runtime import Runtime

_REMARKS = "images.json"  # beside the matches: which images are bad
_SHORTLIST = "shortlist.npz"  # beside the matches of shards
_COMPLETE = "its images and queries are done"


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

    If the cache has a root, matches are kept below it. If they are all there, nothing else is read. If the cache has a
    shard, only queries of the shard are matched.

    Args:
        dataset: of the sequence.
        sequence: Q queries.
        pipeline: how candidates are found and matched.
        cache, runtime: see `evaluate`.
        watch: gets the seconds of the stages.

    Raises:
        InputError: as `evaluate`.
        NotYet: the cache has a shard: its queries are matched, or features of other shards are missing.
    """
    cache, watch, database = cache or FeatureCache(), watch or Stopwatch(), dataset.database
    cache = replace(cache, runtime=runtime or cache.runtime, watch=cache.watch or watch)
    with watch("features"):
        pipeline = replace(pipeline, extractor=fit_to_database(pipeline.extractor, database, cache))
    with watch("retrieval"):
        pipeline = replace(pipeline, retriever=fit_to_database(pipeline.retriever, database, cache))
    with ExitStack() as stack:
        stores = []
        if cache.root is not None:
            recipe = matches_recipe(dataset, sequence, pipeline, cache)
            stores = [stack.enter_context(store) for store in _match_stores(sequence, pipeline, recipe, cache)]
        if cache.shard is not None and all(store.done.all() for store in stores):
            raise NotYet(_COMPLETE)
        matched = _read_matches(sequence, stores, cache, watch)
        if matched is None:
            with watch("retrieval"):
                retrieved = _find_candidates(sequence, database, pipeline, cache, stores)
            matched = _match(dataset, sequence, pipeline, retrieved, stores, cache, watch)
    _warn_of_queries_without_candidates(matched, cache)
    return replace(matched, weights=tuple(scale.weight for scale in pipeline.extractor.scales))


def _find_candidates(
    sequence: QuerySequence,
    database: ImageFolder,
    pipeline: Pipeline,
    cache: FeatureCache,
    stores: Sequence[MatchStore],
) -> RetrievalResult:
    """The shortlist; all runs use that of the first shard, since near ties may come out differently elsewhere."""

    def retrieve() -> RetrievalResult:
        retriever, number = pipeline.retriever, num_candidates(pipeline.candidates, database)
        retrieved = retriever.shortlist(sequence, database, number, cache)
        return validate_candidates(retrieved, type(retriever).__name__, len(sequence.images), len(database), number)

    path = stores[0].folder / _SHORTLIST if stores else None
    if path is None or (cache.shard is None and not path.exists()):
        return retrieve()
    key = path.parent.name
    if not path.exists():
        shortlist, *bad = retrieve()
        arrays = {"indices": shortlist.indices, "scores": shortlist.scores, "bad": np.array(json.dumps(bad))}
        with replacing(path, once=True) as temporary:
            write_arrays(temporary, arrays, key)
    arrays = read_arrays(path, key)
    bad_queries, bad_database = map(_by_row, json.loads(str(arrays["bad"])))
    shortlist = Shortlist(arrays["indices"], arrays["scores"], arrays["indices"] >= 0)
    return RetrievalResult(shortlist, bad_queries, bad_database)


def _match(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, retrieved: RetrievalResult,
    stores: Sequence[MatchStore], cache: FeatureCache, watch: Stopwatch,
) -> Matched:  # fmt: skip
    """Extract features and match all scales; a shard matches its queries, and ends with `NotYet`."""
    with watch("features"):
        sides, remarks = _extract(dataset, sequence, pipeline.extractor, retrieved, cache)
    for store in stores[:1]:  # for later runs, which read the matches and nothing else
        write_text(store.folder / _REMARKS, json.dumps(remarks))
    for line in remarks["warnings"]:
        cache.warn(line)
    shortlist, shard = retrieved.candidates, cache.shard
    rows = None if shard is None else shard.rows(sequence.images.names)
    with watch("matching"):
        matches = tuple(
            stages.match(*scale, shortlist, pipeline.matcher, store=store, rows=rows, runtime=cache.runtime)
            for scale, store in zip(sides, stores or [None] * len(sides), strict=True)
        )
    if shard is not None:
        raise NotYet(_COMPLETE)
    return Matched(sequence, shortlist, matches, remarks["queries"], remarks["database"])


def _extract(
    dataset: Dataset,
    sequence: QuerySequence,
    extractor: Extractor | Source,
    retrieved: RetrievalResult,
    cache: FeatureCache,
) -> tuple[list[tuple[FeatureSet, FeatureSet]], dict[str, Any]]:
    """Features of the queries and of all candidates by scale, and remarks on bad images of both sides."""
    rows = np.unique(retrieved.candidates.indices[retrieved.candidates.mask])
    database, queries = together(
        partial(cache.local, dataset.database, extractor, rows.tolist(), label="database"),
        partial(cache.local, sequence.images, extractor, label=f"query {sequence.name}"),
    )
    bad = {
        "queries": _by_row(retrieved.bad_queries, queries[0].bad),
        "database": _by_row(retrieved.bad_database, database[0].bad),
    }
    warnings = [
        *image_warnings(dataset.database, database[0], bad["database"]),
        *image_warnings(sequence.images, queries[0], bad["queries"]),
    ]
    return list(zip(queries, database, strict=True)), bad | {"warnings": warnings}


def _warn_of_queries_without_candidates(matched: Matched, cache: FeatureCache) -> None:
    missing = [row for row in np.flatnonzero(~matched.candidates.mask.any(axis=1)) if row not in matched.bad_queries]
    if missing:
        images = matched.sequence.images
        cache.warn(f"{images.paths[missing[0]]}: no candidates ({len(missing)} such queries of {len(images)}), which "
                     "counts as a failure")  # fmt: skip


def num_candidates(candidates: int | Literal["all"], database: ImageFolder) -> int:
    """Candidates of a query: as many as the setting says, if the database has so many images."""
    return len(database) if candidates == "all" else min(int(candidates), len(database))


def _by_row(*reasons: Mapping[Any, str]) -> dict[int, str]:
    return {int(row): reason for side in reasons for row, reason in side.items()}


def _read_matches(
    sequence: QuerySequence, stores: Sequence[MatchStore], cache: FeatureCache, watch: Stopwatch
) -> Matched | None:
    """Matches of all scales from the stores; None if some are missing."""
    if not stores or not all(store.done.all() for store in stores):
        return None
    try:
        remarks = json.loads((stores[0].folder / _REMARKS).read_text())
        queries, database, warnings = _by_row(remarks["queries"]), _by_row(remarks["database"]), [*remarks["warnings"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None  # so images are read again, but not matched
    with watch("matches read"):
        scales = [stages.stored_matches(store, memory=cache.runtime.memory) for store in stores]
    match_sets, shortlists = zip(*scales, strict=True)
    if any((shortlist.indices != shortlists[0].indices).any() for shortlist in shortlists):
        return None  # scales with different shortlists: matching will raise
    for line in warnings:
        cache.warn(line)
    return Matched(sequence, shortlists[0], match_sets, queries, database)


def matches_recipe(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, cache: FeatureCache
) -> dict[str, Any]:
    """JSON values that determine a shortlist and its matches: images and features, retrieval, and matcher."""
    excluded, database = sequence.excluded, dataset.database
    extractor = fit_to_database(pipeline.extractor, database, cache)
    return {
        "database": cache.recipe(database, extractor),
        "query": cache.recipe(sequence.images, extractor),
        "filter": cache.recipe_of(fit_to_database(pipeline.retriever, database, cache)),
        "candidates": num_candidates(pipeline.candidates, database),
        "matching": cache.recipe_of(pipeline.matcher),
        "skip_bad": cache.skip_bad,
        "excluded": None if excluded is None else recipe_of([excluded.rows, excluded.offsets]),
    }


def _match_stores(
    sequence: QuerySequence, pipeline: Pipeline, recipe: Mapping[str, Any], cache: FeatureCache
) -> Iterator[AbstractContextManager[MatchStore]]:
    """One store of matches per scale."""
    scales = pipeline.extractor.scales
    share = 1 if recipe["matching"].get("cross_check") in ("none", "candidate") else 3
    for number, scale in enumerate(scales):
        yield cache.matches(
            {**recipe, "scale": number} if len(scales) > 1 else recipe, sequence.images.names, recipe["candidates"],
            typical=scale.typical_count // share, label=f"{sequence.name} matches",
        )  # fmt: skip
