"""All stages in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    ranked = rank_dataset(dataset, mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts()}))
    print(ranked.recall([0.0])["histogram"].pooled)

`mfvpr.evaluate` does this for several data sets and systems, and reports.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.metrics import hits
from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation import stages
from mfvpr.evaluation.rankings import Matched, Ranked, rank_by_scores
from mfvpr.evaluation.system import Pipeline, System, folders_of
from mfvpr.features.extractor import Source
from mfvpr.matchers.host_matcher import PairSource, Side
from mfvpr.matchers.match_set import MatchSet
from mfvpr.retrieval.retriever import RetrievalResult, fit_to_database, fit_to_sequence
from mfvpr.storage.cache_files import MatchStore
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.compiled_programs import keep_compiled_programs
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.runtime import Runtime, Stopwatch

KS = (1, 5, 10)  # depths of recall, by default
_REMARKS = "images.json"  # beside the matches: which images are bad
_OfEvidence = Literal["overexposed", "blurred", "too few features", "too few matches", "no better than noise"]
Reason = Literal[_OfEvidence, "no candidates", "low confidence", "off the map"]  # why there is no place


@dataclass(frozen=True)
class Recall:
    """Recall of one system, from numbers of correct queries and of all queries."""

    correct: Int[np.ndarray, "sequences tolerances ks"]
    queries: Int[np.ndarray, " sequences"]

    @property
    def by_sequence(self) -> Float[np.ndarray, "sequences tolerances ks"]:
        """Recall of each sequence."""
        return self.correct / np.maximum(self.queries, 1)[:, None, None]

    @property
    def mean(self) -> Float[np.ndarray, "tolerances ks"]:
        """Plain mean over the sequences."""
        return self.by_sequence.mean(axis=0)

    @property
    def pooled(self) -> Float[np.ndarray, "tolerances ks"]:
        """Recall over all queries of all sequences."""
        return self.correct.sum(axis=0) / max(self.queries.sum(), 1)


@dataclass(frozen=True, repr=False)
class RankedDataset:
    """Rankings of one data set by one system."""

    dataset: Dataset
    system: System
    matched: Sequence[Matched]  # candidates and matches of each sequence
    systems: Mapping[str, Sequence[Ranked]]  # rankings of each sequence, by name of the final score
    seconds: Mapping[str, float]  # by stage

    def positives(self, threshold: float) -> list[Positives]:
        """Positives at a threshold, by sequence; an InputError without a ground truth of all images."""
        if not threshold >= 0:
            raise InputError(f"threshold={threshold}: expected a number from 0")
        positives = []
        for sequence in self.dataset.sequences:
            if sequence.truth is None:
                raise InputError(f"{self.dataset.name}: expected a data set with ground truth, got rankings only")
            truth = sequence.truth.positives(threshold)
            expected, got = (len(sequence.images), len(self.dataset.database)), (len(truth), truth.num_database)
            if got != expected:
                words = "{} queries and {} database images".format
                raise InputError(f"{sequence.name}: expected a ground truth of {words(*expected)}, got {words(*got)}")
            positives.append(truth)
        return positives

    def recall(self, thresholds: Sequence[float], ks: Sequence[int] = KS) -> dict[str, Recall]:
        """Recall@K of every system; a query without positives counts as a failure. Errors are those of `positives`.

        `thresholds` are the largest distances of a correct prediction, in the unit of the ground truth.
        """
        if min(ks, default=1) < 1:
            raise InputError(f"ks={[*ks]}: expected depths from 1")
        by_threshold = [self.positives(threshold) for threshold in thresholds]
        recalls = {}
        for name, rankings in self.systems.items():
            correct = [
                [[hits(ranking.rows, each[sequence], k).sum() for k in ks] for each in by_threshold]
                for sequence, ranking in enumerate(rankings)
            ]
            shape, queries = (len(rankings), len(by_threshold), len(ks)), [len(ranking.rows) for ranking in rankings]
            recalls[name] = Recall(np.array(correct, int).reshape(shape), np.array(queries))
        return recalls


def rank_dataset(
    dataset: Dataset, system: System, *, cache: FeatureCache | None = None, runtime: Runtime | None = None
) -> RankedDataset:
    """Rank every query's candidates by the retrieval, by every scorer, and by combined scores.

    The `cache` (None = in memory) keeps features, matches and compiled programs; its runtime is the default. An
    InputError says in one line which image, store, or result of an extractor, the retrieval or a scorer is unusable.
    """
    watch, cache = Stopwatch(), cache or FeatureCache()
    cache = replace(cache, runtime=runtime or cache.runtime, watch=watch)
    if cache.root is not None:
        keep_compiled_programs()
    system = system.fit_image_size(folders_of(dataset), cache.warn)
    systems: dict[str, list[Ranked]] = {}
    matched = [match_sequence(dataset, each, system.pipeline, cache=cache) for each in dataset.sequences]
    for sequence in matched:
        with watch("scores"):
            scores = stages.score(system.scorers, sequence.by_scale, sequence.candidates, runtime=cache.runtime)
        finals, excluded = system.final_scores.values(), sequence.sequence.excluded
        rankings = rank_by_scores(
            sequence.candidates, scores, finals, system.ties, num_rows=len(dataset.database), excluded=excluded
        )
        for name, ranking in rankings.items():
            systems.setdefault(name, []).append(ranking)
            values = ranking.scores[ranking.rows >= 0]
            for words, is_bad in (("NaN, and rank last", np.isnan(values)), ("infinite", np.isinf(values))):
                if count := int(is_bad.sum()):
                    cache.warn(f"{sequence.sequence.name}: {count} scores of {name} are {words}")
    for name in system.scorers:
        stages.require_finite(name, np.concatenate([ranked.scores[ranked.rows >= 0] for ranked in systems[name]]))
    return RankedDataset(dataset, system, matched, systems, watch.seconds)


def match_sequence(
    dataset: Dataset,
    sequence: QuerySequence,
    pipeline: Pipeline,
    *,
    cache: FeatureCache | None = None,
    runtime: Runtime | None = None,
) -> Matched:
    """Find and match the candidates of one sequence's queries; features of other database images are not extracted.

    If a cache with a root has all matches, nothing else is read. Its watch gets the seconds of the stages; arguments
    and errors are those of `mfvpr.evaluate`.
    """
    cache, database = cache or FeatureCache(), dataset.database
    watch = cache.watch or Stopwatch()
    cache = replace(cache, runtime=runtime or cache.runtime, watch=watch)
    tool, masks = pipeline.image_source or pipeline.extractor, database.masks or sequence.images.masks
    if masks is not None and isinstance(tool, PairSource | Source):
        got = f"{type(tool).__name__}, which knows no masks; leave them out"
        raise InputError(f"masks={masks}: expected an extractor and a matcher of its features, got {got}")
    if pipeline.pixels is not None:
        pipeline = pipeline.with_image_size(pipeline.size_for_images(folders_of(dataset), cache.warn))
    if pipeline.image_source is None:
        with watch("features"):
            pipeline = replace(pipeline, extractor=fit_to_database(pipeline.extractor, database, cache))
    with watch("retrieval"):
        retriever = fit_to_sequence(fit_to_database(pipeline.retriever, database, cache), sequence)
        pipeline = replace(pipeline, retriever=retriever)
    number = num_candidates(pipeline.candidates, database)
    recipe, stores = cache.recipe(lambda: matches_recipe(dataset, sequence, pipeline, cache)), list[MatchStore]()
    if recipe is not None and cache.root is not None:
        scales = range(len(pipeline.scales))
        stores = [MatchStore(cache.root, recipe | {"scale": scale}, len(sequence.images)) for scale in scales]
    stored = _read_matches(sequence, stores, cache, watch) if stores else None
    if stored is None:
        with watch("retrieval"):
            retrieved = retriever.shortlist(sequence, database, number, cache)
            retrieved = _check_candidates(retrieved, type(retriever).__name__, (len(sequence.images), number), database)
        with watch("features"):
            sides, remarks = _extract(dataset, sequence, pipeline, retrieved, cache)
        for store in stores[:1]:  # for later runs, which read the matches and nothing else
            cache.runtime.log(f"{sequence.name} matches: {len(sequence.images)} queries, in {store.folder}")
            write_text(store.folder / _REMARKS, json.dumps(remarks))
        with watch("matching"):
            matches = tuple(
                stages.match(*scale, retrieved.candidates, pipeline.matcher, store=store, runtime=cache.runtime)
                for scale, store in zip(sides, stores or [None] * len(sides), strict=True)
            )
        stored = matches, retrieved.candidates, remarks
    matches, candidates, remarks = stored
    for line in remarks["warnings"]:
        cache.warn(line)
    sides = "queries", "database"
    bad_queries, bad_database = ({int(row): reason for row, reason in remarks[side].items()} for side in sides)
    there = candidates.mask
    empty = int((there & (matches[0].counts == 0)).sum())
    if pipeline.image_source is not None and empty and 2 * empty >= there.sum():
        cache.warn(f"{sequence.name}: {empty} of {there.sum()} pairs have no matches; they score 0")
    if missing := [row for row in np.flatnonzero(~there.any(axis=1)) if row not in bad_queries]:
        queries = f"{len(missing)} such queries of {len(sequence.images)}"
        cache.warn(f"{sequence.images.paths[missing[0]]}: no candidates ({queries}), which counts as a failure")
    weights = tuple(scale.weight for scale in pipeline.scales)
    return Matched(sequence, candidates, matches, bad_queries, bad_database, weights)


def num_candidates(candidates: int | Literal["all"], database: ImageFolder) -> int:
    """Candidates of a query: as many as the setting says, if the database has so many images."""
    return len(database) if candidates == "all" else min(int(candidates), len(database))


def matches_recipe(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, cache: FeatureCache
) -> dict[str, Any]:
    """JSON values that determine a shortlist and its matches: images and features, retrieval, and matcher."""
    database, extractor = dataset.database, None
    if pipeline.image_source is None:
        extractor = fit_to_database(pipeline.extractor, database, cache)
    return {
        "database": cache.recipes.of_folder(database, extractor),
        "query": cache.recipes.of_folder(sequence.images, extractor),
        "filter": cache.recipes.of(fit_to_sequence(fit_to_database(pipeline.retriever, database, cache), sequence)),
        "candidates": num_candidates(pipeline.candidates, database),
        "matching": cache.recipes.of(pipeline.matcher),
        "skip_bad": cache.skip_bad,
        "excluded": recipe_of(sequence.excluded),
    }


def _read_matches(
    sequence: QuerySequence, stores: Sequence[MatchStore], cache: FeatureCache, watch: Stopwatch
) -> tuple[tuple[MatchSet, ...], Shortlist, dict[str, Any]] | None:
    """Matches of all scales from the stores, their shortlist, and remarks on images; None if some are missing."""
    if not all(store.is_complete for store in stores):
        return None
    try:
        remarks = json.loads((stores[0].folder / _REMARKS).read_text())
    except (OSError, ValueError):
        return None  # so images are read again, but not matched
    cache.runtime.log(f"{sequence.name} matches: all {len(sequence.images)} queries from {stores[0].folder}")
    with watch("matches read"):
        scales = [scale for store in stores if (scale := stages.stored_matches(store, memory=cache.runtime.memory))]
    if len(scales) < len(stores):
        cache.warn(f"{stores[0].folder}: has damaged files; their queries are matched again")
        return None
    match_sets, [shortlist, *_] = zip(*scales, strict=True)
    return match_sets, shortlist, remarks


def _extract(
    dataset: Dataset, sequence: QuerySequence, pipeline: Pipeline, retrieved: RetrievalResult, cache: FeatureCache
) -> tuple[list[tuple[Side, Side]], dict[str, Any]]:
    """Features of the queries and of all candidates by scale, or their images, and remarks on bad images."""
    extractor, candidates, sides = pipeline.extractor, retrieved.candidates, (sequence.images, dataset.database)
    remarks: dict[str, Any] = {"queries": retrieved.bad_queries, "database": retrieved.bad_database}
    if (source := pipeline.image_source) is not None:
        return [sides], remarks | {"warnings": source.open(*sides).warnings(candidates)}
    rows = np.unique(candidates.indices[candidates.mask]).tolist()
    database = cache.local(dataset.database, extractor, rows, label="database")
    queries = cache.local(sequence.images, extractor, label=f"query {sequence.name}")
    warnings = list[str]()
    for side, folder, features in (("database", dataset.database, database), ("queries", sequence.images, queries)):
        bad = remarks[side] = {**remarks[side], **features[0].bad}
        warnings += bad.values()
        empty = [row for row in np.flatnonzero(features[0].source.counts == 0).tolist() if row not in bad]
        if empty:
            words = f"no keypoints, so no matches ({len(empty)} such images of {len(folder)}); scores are 0"
            warnings.append(f"{folder.paths[empty[0]]}: {words}")
    return list(zip(queries, database, strict=True)), remarks | {"warnings": warnings}


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
    listed = [rows[present] for rows, present in zip(indices, mask, strict=True)]
    for query, rows in enumerate(listed):
        if not ((rows >= 0) & (rows < len(database))).all() or len({*rows.tolist()}) < len(rows):
            expected = f"different rows of the database from 0 to {len(database) - 1}"
            raise InputError(f"{name}: expected {expected}, got {rows.tolist()} for query {query}")
    if not np.isfinite(scores[mask]).all():
        raise InputError(f"{name}: expected finite scores")
    indices, scores = np.where(mask, indices, -1).astype(np.int32), np.where(mask, scores, 0).astype(np.float32)
    return retrieved._replace(candidates=Shortlist(indices, scores, mask))
