"""Matches of a sequence: images -> features -> shortlist -> matches, kept in the folder of a cache, if any."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.rankings import Matched
from mfvpr.evaluation.system import Pipeline, folders_of
from mfvpr.evaluation.validation import empty_pairs_warning, image_warnings, validate_candidates
from mfvpr.matchers.host_matcher import Side
from mfvpr.matchers.match_set import MatchSet
from mfvpr.retrieval.fitting import fit_to_database
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.storage.cache_files import MatchStore
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.runtime import Runtime, Stopwatch

_REMARKS = "images.json"  # beside the matches: which images are bad


@dataclass(frozen=True)
class _Work:
    """A sequence to be matched: the parts of the pipeline are fitted to the database, the cache has its runtime."""

    dataset: Dataset
    sequence: QuerySequence
    pipeline: Pipeline
    cache: FeatureCache
    watch: Stopwatch

    @classmethod
    def fit(
        cls, dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, cache: FeatureCache, watch: Stopwatch
    ) -> "_Work":
        """Learn the parts that depend on the database."""
        cache = replace(cache, watch=cache.watch or watch)
        if pipeline.pixels is not None:
            pipeline = pipeline.with_image_size(pipeline.size_for_images(folders_of(dataset), cache.warn))
        if pipeline.image_source is None:
            with watch("features"):
                pipeline = replace(pipeline, extractor=fit_to_database(pipeline.extractor, dataset.database, cache))
        with watch("retrieval"):
            pipeline = replace(pipeline, retriever=fit_to_database(pipeline.retriever, dataset.database, cache))
        return cls(dataset, sequence, pipeline, cache, watch)


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
    cache = cache or FeatureCache()
    cache = replace(cache, runtime=runtime or cache.runtime)
    work = _Work.fit(dataset, sequence, pipeline, cache, watch or Stopwatch())
    stores = _match_stores(work)
    matched = _read_matches(work, stores)
    if matched is None:
        retrieved = _find_candidates(work)
        matches, remarks = _match(work, retrieved, stores)
        matched = Matched(sequence, retrieved.candidates, matches, remarks["queries"], remarks["database"])
    if work.pipeline.image_source is not None:
        for line in empty_pairs_warning(sequence.name, matched):
            cache.warn(line)
    missing = [row for row in np.flatnonzero(~matched.candidates.mask.any(axis=1)) if row not in matched.bad_queries]
    if missing:
        number = f"{len(missing)} such queries of {len(sequence.images)}"
        cache.warn(f"{sequence.images.paths[missing[0]]}: no candidates ({number}), which counts as a failure")
    return replace(matched, weights=tuple(scale.weight for scale in work.pipeline.scales))


def _find_candidates(work: _Work) -> RetrievalResult:
    sequence, database, retriever = work.sequence, work.dataset.database, work.pipeline.retriever
    number = num_candidates(work.pipeline.candidates, database)
    with work.watch("retrieval"):
        retrieved = retriever.shortlist(sequence, database, number, work.cache)
        return validate_candidates(retrieved, type(retriever).__name__, len(sequence.images), len(database), number)


def _match(
    work: _Work, retrieved: RetrievalResult, stores: Sequence[MatchStore], rows: Sequence[int] | None = None
) -> tuple[tuple[MatchSet, ...], dict[str, Any]]:
    """Extract features and match all scales, of all queries or of those in `rows`; also remarks on bad images."""
    with work.watch("features"):
        sides, remarks = _extract(work, retrieved)
    for store in stores[:1]:  # for later runs, which read the matches and nothing else
        write_text(store.folder / _REMARKS, json.dumps(remarks))
    for line in remarks["warnings"]:
        work.cache.warn(line)
    options = {"rows": rows, "runtime": work.cache.runtime}
    with work.watch("matching"):
        matches = tuple(
            stages.match(*scale, retrieved.candidates, work.pipeline.matcher, store=store, **options)
            for scale, store in zip(sides, stores or [None] * len(sides), strict=True)
        )
    return matches, remarks


def _extract(work: _Work, retrieved: RetrievalResult) -> tuple[list[tuple[Side, Side]], dict[str, Any]]:
    """Features of the queries and of all candidates by scale, or their images, and remarks on bad images."""
    dataset, sequence, extractor = work.dataset, work.sequence, work.pipeline.extractor
    if (source := work.pipeline.image_source) is not None:
        sides = sequence.images, dataset.database
        remarks = {"queries": retrieved.bad_queries, "database": retrieved.bad_database}
        return [sides], {**remarks, "warnings": source.open(*sides).warnings(retrieved.candidates)}
    rows = np.unique(retrieved.candidates.indices[retrieved.candidates.mask])
    database = work.cache.local(dataset.database, extractor, rows.tolist(), label="database")
    queries = work.cache.local(sequence.images, extractor, label=f"query {sequence.name}")
    bad_queries = _by_row(retrieved.bad_queries, queries[0].bad)
    bad_database = _by_row(retrieved.bad_database, database[0].bad)
    warnings = [*image_warnings(dataset.database, database[0], bad_database)]
    warnings += image_warnings(sequence.images, queries[0], bad_queries)
    remarks = {"queries": bad_queries, "database": bad_database, "warnings": warnings}
    return list(zip(queries, database, strict=True)), remarks


def num_candidates(candidates: int | Literal["all"], database: ImageFolder) -> int:
    """Candidates of a query: as many as the setting says, if the database has so many images."""
    return len(database) if candidates == "all" else min(int(candidates), len(database))


def _by_row(*reasons: Mapping[Any, str]) -> dict[int, str]:
    return {int(row): reason for side in reasons for row, reason in side.items()}


def _read_matches(work: _Work, stores: Sequence[MatchStore]) -> Matched | None:
    """Matches of all scales from the stores; None if some are missing."""
    if not stores or not all(store.has_all(range(store.num_queries)) for store in stores):
        return None
    try:
        remarks = json.loads((stores[0].folder / _REMARKS).read_text())
        queries, database, warnings = _by_row(remarks["queries"]), _by_row(remarks["database"]), [*remarks["warnings"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None  # so images are read again, but not matched
    with work.watch("matches read"):
        scales = [
            scale for store in stores if (scale := stages.stored_matches(store, memory=work.cache.runtime.memory))
        ]
    if len(scales) < len(stores):
        work.cache.warn(f"{stores[0].folder}: has damaged files; their queries are matched again")
        return None
    match_sets, shortlists = zip(*scales, strict=True)
    if any((shortlist.indices != shortlists[0].indices).any() for shortlist in shortlists):
        return None  # scales with different shortlists: matching will raise
    for line in warnings:
        work.cache.warn(line)
    return Matched(work.sequence, shortlists[0], match_sets, queries, database)


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


def _match_stores(work: _Work) -> list[MatchStore]:
    """One store per scale of the matches; none if the cache is in memory, or a part of the pipeline has no recipe."""
    cache, number = work.cache, len(work.sequence.images)
    recipe = cache.recipe(lambda: matches_recipe(work.dataset, work.sequence, work.pipeline, cache))
    if recipe is None or cache.root is None:
        return []
    stores = [MatchStore(cache.root, recipe | {"scale": scale}, number) for scale in range(len(work.pipeline.scales))]
    is_done = all(store.has_all(range(number)) for store in stores)
    line = f"all {number} queries from" if is_done else f"{number} queries with {recipe['candidates']} candidates, in"
    cache.log(f"{work.sequence.name} matches: {line} {stores[0].folder}")
    return stores
