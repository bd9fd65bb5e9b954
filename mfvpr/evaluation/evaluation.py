"""The whole way in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    result = mfvpr.evaluate(dataset, sift, Retrieval(Aggregated(sift, VladFitting())),
                            {"histogram": mfvpr.HistogramOfShifts()}, candidates=50)
    print(result.recall([0.0])["histogram"].pooled)

Features, shortlist and matches are kept in an archive, where that has a folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.results import Result
from mfvpr.evaluation.sequence_matching import match_sequence, matches_recipe
from mfvpr.evaluation.validation import check_request, nan_scores
from mfvpr.features.extractor import Extractor, Source
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.cohort_normalization import cohort_sequence, hubness
from mfvpr.reranking.frame_correlation import FrameCorrelation
from mfvpr.reranking.fusion import Fusion, rank_sequence
from mfvpr.reranking.ranking import Ties
from mfvpr.reranking.results import COHORT, Matched
from mfvpr.retrieval.retriever import Filter
from mfvpr.scoring.scorer import Scorer
from mfvpr.storage.feature_cache import Archive
from mfvpr.storage.manifest import SCORES, store_path
from mfvpr.storage.scores import QueryScores, ScoreStore, open_score_store
from mfvpr.storage.shards import together
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device
from mfvpr.utils.progress import Stopwatch

Tools = tuple[Extractor | Source, Filter, int | Literal["all"]]
Scored = tuple[Matched, dict[str, np.ndarray]]  # of a sequence, and its scores [Q, C] by name of the scorer


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
    archive: Archive | None = None,
    memory: float | None = None,
    devices: Sequence[Device] | None = None,
    watch: Stopwatch | None = None,
) -> Result:
    """Rank every query's candidates by every scorer.

    Args:
        dataset: one database, one or more query sequences.
        extractor: what takes local features from images, or has them, see `mfvpr.retrieval.precomputed`.
        filter: what finds candidates.
        scorers: by name.
        candidates: that the filter proposes for each query.
        matching: what matches a pair, see `mfvpr.Matcher`.
        fused: scorers, by name, that are ranked together with the filter's score as well, as `name + filter`, or with
            other scorers' and the filter's, as `name + other + filter`; see `mfvpr.reranking.fusion.Fusion`.
        correlated: scorers and those that are fused, by name, that are ranked by their scores with frame correlation as
            well, as `name + frames`.
        cohort: all scorers are ranked with a cohort as well, as `name + cohort`: database images that score high with
            other places lose as much (`mfvpr.reranking.cohort_normalization`). The number says how many frames on both
            sides of an image show its place, and are left out; None = no cohort.
        ties: equal scores keep the order of the filter, or go by the row of the database: "filter", "index".
        archive: where features and matches are kept; None = in memory.
        memory: GB that features of the database may take on the devices, and matches that are kept in memory; None = a
            third of what is free.
        devices: that share the queries; None = the one that JAX takes.
        watch: gets the seconds of the stages; all that a cohort takes is a stage of its own, but for the extraction of
            local features, which is the stage `features` also where the filter or a cohort asks for it.

    Raises:
        InputError: arguments, images, stores or features that cannot be used, or what an extractor, a filter or a
            scorer gives; one line says which, and the mend.
        NotYet: the archive is that of a shard, which has done its part, and others have not; see
            `mfvpr.storage.shards`.
    """
    fused, correlated = fused or {}, correlated or {}
    check_request(scorers, fused, correlated, ties, memory, cohort=cohort is not None)
    watch = watch or Stopwatch()
    archive = replace(archive or Archive(), watch=watch)
    tools = (extractor, filter, candidates)
    how = {"matching": matching, "archive": archive, "memory": memory, "devices": devices}
    calls = [partial(_scored, dataset, sequence, tools, scorers, watch, **how) for sequence in dataset.sequences]
    if cohort is not None:
        others = cohort_sequence(archive.contents(dataset.database), cohort)
        calls.insert(0, partial(_scored_cohort, dataset, others, tools, scorers, watch, **how))
    found: list[Scored] = together(*calls)
    strengths: dict[str, np.ndarray] = {}
    if cohort is not None:
        among, scores = found.pop(0)
        strengths = {
            name: hubness(among.candidates, values, len(dataset.database), who=name) for name, values in scores.items()
        }
    matched = [one for one, _ in found]
    ranked = [rank_sequence(one, scores, fused, correlated, ties, hubness=strengths) for one, scores in found]
    for line in nan_scores(matched, ranked, scorers):
        archive.warn(line)
    systems = {name: [by_system[name] for by_system in ranked] for name in ranked[0]}
    return Result(dataset, matched, systems, watch.seconds)


def _scored(
    dataset: Dataset,
    sequence: QuerySequence,
    tools: Tools,
    scorers: Mapping[str, Scorer],
    watch: Stopwatch,
    *,
    archive: Archive,
    label: str = "",
    **how: Any,
) -> Scored:
    """All of a sequence; a shard scores its own queries, and asks the others' of their stores."""

    def match(rows: Sequence[int] | None = None) -> Matched:
        options: dict[str, Any] = how | ({"track": archive.track(f"{label}matching")} if label else {})
        return match_sequence(dataset, sequence, *tools, archive=archive, watch=watch, rows=rows, **options)

    def score(matched: Matched) -> dict[str, np.ndarray]:
        with watch("scores"):
            track = archive.track(f"{label}scores")
            return stages.score(scorers, matched.by_scale, matched.candidates, devices=how["devices"], track=track)

    if archive.shard is None or archive.root is None:
        matched = match()
        return matched, score(matched)
    names, who = sequence.images.names, sorted(scorers)
    with _score_store(dataset, sequence, tools, scorers, how["matching"], archive) as store:
        own = archive.shard.rows(names)
        missing = [row for row in own if not store.done[row]]
        # One without queries has images to take; and what is done together, all must do or none.
        if missing or not own or (archive.shard.meets and not store.done.all()):
            part = match(own)
            if missing:  # all are scored, so that what goes on has the bits of one run
                found = score(part)
                by_query = np.stack([found[name] for name in who], axis=1)
                rows = dict(zip(own, map(QueryScores, by_query, np.asarray(part.candidates.indices)), strict=True))
                store.write({row: rows[row] for row in missing})

        def lacking() -> Sequence[int]:
            store.look()
            return np.flatnonzero(~store.done).tolist()

        archive.shard.wait(lacking, names, f"{sequence.name} scores", patience=archive.patience, is_complete=True)
        stored = [query for _, query in store.read()]
    matched = match()
    if (np.stack([query.indices for query in stored]) != matched.candidates.indices).any():
        raise InputError(f"{store.folder}: expected scores of these candidates, got those of another shortlist; delete "
                         "this folder, and run again")  # fmt: skip
    by_scorer = np.stack([query.scores for query in stored], axis=1)
    return matched, {name: by_scorer[who.index(name)] for name in scorers}


def _score_store(
    dataset: Dataset, sequence: QuerySequence, tools: Tools, scorers: Mapping[str, Scorer], matching: Matcher,
    archive: Archive,
) -> ScoreStore:  # fmt: skip
    """Of a shard; scorers are told by what they are, not by what they call."""
    if archive.root is None or not scorers:
        raise InputError("scorers: expected at least one, got none; a shard keeps their scores")
    recipes, extractor = {}, tools[0]
    for name, scorer in scorers.items():
        try:
            recipes[name] = archive.recipe_of(scorer)
        except TypeError as error:
            raise InputError(f"{name}: a shard keeps scores, and must know what makes them: {error}") from None
    recipe = {
        "matches": matches_recipe(dataset, sequence, *tools, matching, archive),
        "scorers": recipes,
        "scale weights": [scale.weight for scale in extractor.scales],
    }
    path = store_path(archive.root, "scores", recipe, SCORES)
    return open_score_store(path, recipe, num_queries=len(sequence.images), **archive.store_options)


def _scored_cohort(
    dataset: Dataset, others: QuerySequence, tools: Any, scorers: Any, watch: Stopwatch, **how: Any
) -> Scored:
    """Of the database among itself: a stage of its own."""
    with watch(COHORT):
        return _scored(dataset, others, tools, scorers, Stopwatch(), label="cohort ", **how)
