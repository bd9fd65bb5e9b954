"""All stages in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    result = mfvpr.evaluate(dataset, sift, Retrieval(Aggregated(sift, VladFitting())),
                            {"histogram": mfvpr.HistogramOfShifts()}, candidates=50)
    print(result.recall([0.0])["histogram"].pooled)

Features, shortlist and matches are kept in the folder of a cache, if it has one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.results import Result
from mfvpr.evaluation.sequence_matching import match_sequence, matches_recipe
from mfvpr.evaluation.validation import check_request, score_warnings
from mfvpr.features.extractor import Extractor, Source
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.cohort_normalization import cohort_sequence, hubness
from mfvpr.reranking.frame_correlation import FrameCorrelation
from mfvpr.reranking.fusion import Fusion, rank_sequence
from mfvpr.reranking.ranking import Ties
from mfvpr.reranking.results import COHORT, Matched
from mfvpr.retrieval.retriever import Filter
from mfvpr.scoring.scorer import Scorer
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.manifest import SCORES, store_path
from mfvpr.storage.scores import QueryScores, ScoreStore, open_score_store
from mfvpr.storage.shards import Shard, together
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device
from mfvpr.utils.progress import Stopwatch

Tools = tuple[Extractor | Source, Filter, int | Literal["all"]]
Scored = tuple[Matched, dict[str, np.ndarray]]  # a sequence, and its scores [Q, C] by name of the scorer


def evaluate(
    dataset: Dataset,
    extractor: Extractor | Source,
    filter: Filter,
    scorers: Mapping[str, Scorer],
    *,
    candidates: int | Literal["all"] = 50,
    matching: Matcher = NEIGHBORS,
    fused: Mapping[str, Fusion] | None = None,
    correlated: Mapping[str, FrameCorrelation] | None = None,
    cohort: int | None = None,
    ties: Ties = "filter",
    cache: FeatureCache | None = None,
    memory: float | None = None,
    devices: Sequence[Device] | None = None,
    watch: Stopwatch | None = None,
) -> Result:
    """Rank every query's candidates by every scorer.

    Args:
        dataset: one database, one or more query sequences.
        extractor: extracts local features, or reads them, see `mfvpr.retrieval.precomputed`.
        filter: the retrieval, which finds candidates.
        scorers: by name.
        candidates: number of candidates of each query.
        matching: matches a pair, see `mfvpr.Matcher`.
        fused: by name of a scorer, how its score is combined with the retrieval's (system `name + filter`), or with
            other scorers' and the retrieval's (`name + other + filter`); see `mfvpr.reranking.fusion.Fusion`.
        correlated: by name of a scorer or a fused system, how its scores are correlated with those of the queries
            before (`name + frames`).
        cohort: rank by every scorer with a cohort as well: database images that score high with other places lose as
            much (`mfvpr.reranking.cohort_normalization`). The number says how many frames on both sides of an image
            show its place, and are left out; None = no cohort.
        ties: equal scores keep the order of the retrieval, or go by the row of the database: "filter", "index".
        cache: where features and matches are kept; None = in memory.
        memory: GB that features of the database may take on the devices, and matches that are kept in memory; None = a
            third of what is free.
        devices: that share the queries; None = the one that JAX takes.
        watch: gets the seconds of the stages. A cohort is a stage of its own. The extraction of local features always
            counts as the stage `features`.

    Raises:
        InputError: arguments, images, stores or features that cannot be used, or an invalid result of an extractor, the
            retrieval or a scorer; one line says which, and how to fix it.
        NotYet: this shard has done its part, but other shards have not; see `mfvpr.storage.shards`.
    """
    fused, correlated = fused or {}, correlated or {}
    check_request(scorers, fused, correlated, ties, memory, cohort=cohort is not None)
    watch = watch or Stopwatch()
    cache = replace(cache or FeatureCache(), watch=watch)
    tools = (extractor, filter, candidates)
    options = {"matching": matching, "cache": cache, "memory": memory, "devices": devices}
    calls = [partial(_score, dataset, sequence, tools, scorers, watch, **options) for sequence in dataset.sequences]
    if cohort is not None:
        sequence = cohort_sequence(cache.contents(dataset.database), cohort)
        calls.insert(0, partial(_score_cohort, dataset, sequence, tools, scorers, watch, **options))
    scored: list[Scored] = together(*calls)
    strengths = {} if cohort is None else _hubness(*scored.pop(0), len(dataset.database))
    matched = [sequence for sequence, _ in scored]
    ranked = [
        rank_sequence(sequence, scores, fused, correlated, ties, hubness=strengths) for sequence, scores in scored
    ]
    for line in score_warnings(matched, ranked, scorers):
        cache.warn(line)
    systems = {name: [by_system[name] for by_system in ranked] for name in ranked[0]}
    return Result(dataset, matched, systems, watch.seconds)


def _score(
    dataset: Dataset,
    sequence: QuerySequence,
    tools: Tools,
    scorers: Mapping[str, Scorer],
    watch: Stopwatch,
    *,
    cache: FeatureCache,
    label: str = "",
    **options: Any,
) -> Scored:
    """Match and score a sequence; a shard computes scores of its own queries and reads those of other shards."""

    def match(rows: Sequence[int] | None = None) -> Matched:
        tracked: dict[str, Any] = options | ({"track": cache.track(f"{label}matching")} if label else {})
        return match_sequence(dataset, sequence, *tools, cache=cache, watch=watch, rows=rows, **tracked)

    def score(matched: Matched) -> dict[str, np.ndarray]:
        with watch("scores"):
            track = cache.track(f"{label}scores")
            return stages.score(scorers, matched.by_scale, matched.candidates, devices=options["devices"], track=track)

    if cache.shard is None or cache.root is None:
        matched = match()
        return matched, score(matched)
    scorer_names = sorted(scorers)
    with _score_store(dataset, sequence, tools, scorers, options["matching"], cache) as store:
        _write_scores(store, cache.shard, sequence.images.names, scorer_names, match, score)

        def missing_rows() -> Sequence[int]:
            store.look()
            return np.flatnonzero(~store.done).tolist()

        cache.shard.wait(
            missing_rows, sequence.images.names, f"{sequence.name} scores", patience=cache.patience, is_complete=True
        )
        stored = [query for _, query in store.read()]
    matched = match()
    if (np.stack([query.indices for query in stored]) != matched.candidates.indices).any():
        raise InputError(f"{store.folder}: expected scores of these candidates, got those of another shortlist; delete "
                         "this folder, and run again")  # fmt: skip
    by_scorer = np.stack([query.scores for query in stored], axis=1)
    return matched, {name: by_scorer[scorer_names.index(name)] for name in scorers}


def _write_scores(
    store: ScoreStore, shard: Shard, names: Sequence[str], scorer_names: Sequence[str],
    match: Callable[[Sequence[int]], Matched], score: Callable[[Matched], dict[str, np.ndarray]],
) -> None:  # fmt: skip
    """Match and score the queries of a shard, and write the missing scores."""
    rows = shard.rows(names)
    missing = [row for row in rows if not store.done[row]]
    # A shard without queries still extracts features of images; and all shards must join collective computations.
    if missing or not rows or (shard.meets and not store.done.all()):
        matched = match(rows)
        if missing:  # all rows are scored, so that a continued run has the bits of a single one
            scores = score(matched)
            by_query = np.stack([scores[name] for name in scorer_names], axis=1)
            queries = dict(zip(rows, map(QueryScores, by_query, np.asarray(matched.candidates.indices)), strict=True))
            store.write({row: queries[row] for row in missing})


def _score_store(
    dataset: Dataset, sequence: QuerySequence, tools: Tools, scorers: Mapping[str, Scorer], matching: Matcher,
    cache: FeatureCache,
) -> ScoreStore:  # fmt: skip
    """Open a shard's store of scores. Its recipe covers the code of the scorers, but not of functions they call."""
    if cache.root is None or not scorers:
        raise InputError("scorers: expected at least one, got none; a shard keeps their scores")
    recipes, extractor = {}, tools[0]
    for name, scorer in scorers.items():
        try:
            recipes[name] = cache.recipe_of(scorer)
        except TypeError as error:
            raise InputError(f"{name}: a shard keeps scores, and must know what makes them: {error}") from None
    recipe = {
        "matches": matches_recipe(dataset, sequence, *tools, matching, cache),
        "scorers": recipes,
        "scale weights": [scale.weight for scale in extractor.scales],
    }
    path = store_path(cache.root, "scores", recipe, SCORES)
    return open_score_store(path, recipe, num_queries=len(sequence.images), **cache.store_options)


def _hubness(matched: Matched, scores: Mapping[str, np.ndarray], num_database: int) -> dict[str, np.ndarray]:
    """Hubness `[N]` of the database images by name of the scorer, from the matches and scores of the cohort."""
    return {name: hubness(matched.candidates, values, num_database, name=name) for name, values in scores.items()}


def _score_cohort(
    dataset: Dataset, sequence: QuerySequence, tools: Tools, scorers: Any, watch: Stopwatch, **options: Any
) -> Scored:
    """Match and score the database with itself, as a stage of its own."""
    with watch(COHORT):
        return _score(dataset, sequence, tools, scorers, Stopwatch(), label="cohort ", **options)
