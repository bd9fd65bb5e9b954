"""All stages in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    result = mfvpr.evaluate(dataset, sift, Retrieval(Aggregated(sift, VladFitting())),
                            {"histogram": mfvpr.HistogramOfShifts()}, candidates=50)
    print(result.recall([0.0])["histogram"].pooled)

Features, shortlist and matches are kept in the folder of a cache, if it has one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.results import Result
from mfvpr.evaluation.sequence_matching import match_sequence
from mfvpr.evaluation.validation import check_request, score_warnings
from mfvpr.features.extractor import Extractor, Source
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.cohort_normalization import cohort_sequence, hubness
from mfvpr.reranking.frame_correlation import FrameCorrelation
from mfvpr.reranking.fusion import Fusion, rank_sequence
from mfvpr.reranking.ranking import Ties
from mfvpr.reranking.results import COHORT, Matched
from mfvpr.retrieval.retriever import Retriever
from mfvpr.scoring.scorer import Scorer
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.shards import together
from mfvpr.utils.numerics import Device
from mfvpr.utils.progress import Stopwatch

Scored = tuple[Matched, dict[str, np.ndarray]]  # a sequence, and its scores [Q, C] by name of the scorer


def evaluate(
    dataset: Dataset, extractor: Extractor | Source, retriever: Retriever, scorers: Mapping[str, Scorer], *,
    candidates: int | Literal["all"] = 50, matcher: Matcher = NEIGHBORS,
    fused: Mapping[str, Fusion] | None = None, correlated: Mapping[str, FrameCorrelation] | None = None,
    cohort: int | None = None, ties: Ties = "retrieval", cache: FeatureCache | None = None, memory: float | None = None,
    devices: Sequence[Device] | None = None, watch: Stopwatch | None = None,
) -> Result:  # fmt: skip
    """Rank every query's candidates by every scorer.

    Args:
        dataset: one database, one or more query sequences.
        extractor: extracts local features, or reads them, see `mfvpr.retrieval.precomputed`.
        retriever: the retrieval, which finds candidates.
        scorers: by name.
        candidates: number of candidates of each query.
        matcher: matches a pair, see `mfvpr.Matcher`.
        fused: by name of a scorer, how its score is combined with the retrieval's (system `name + retrieval`), or with
            other scorers' and the retrieval's (`name + other + retrieval`).
        correlated: by name of a scorer or a fused system, how its scores are correlated with those of the queries
            before (`name + frames`).
        cohort: rank with a cohort as well, see `mfvpr.reranking.cohort_normalization`: the number of frames on both
            sides of a database image that show its place, and are left out; None = no cohort.
        ties: equal scores keep the order of the retrieval, or go by the row of the database: "retrieval", "index".
        cache: where features and matches are kept; None = in memory.
        memory: GB that features of the database may take on the devices, and matches that are kept in memory; None = a
            third of what is free.
        devices: that share the queries; None = the one that JAX takes.
        watch: gets the seconds of the stages. Extraction always counts as `features`; a cohort is a stage of its own.

    Raises:
        InputError: arguments, images, stores or features that cannot be used, or an invalid result of an extractor, the
            retrieval or a scorer; one line says which, and how to fix it.
        NotYet: the cache has a shard, which has done what it can; see `mfvpr.storage.shards`.
    """
    fused, correlated, watch = fused or {}, correlated or {}, watch or Stopwatch()
    check_request(scorers, fused, correlated, ties, memory, cohort=cohort is not None)
    cache = replace(cache or FeatureCache(), watch=watch)
    where = {"memory": memory, "devices": devices}
    scoring = _Scoring(dataset, (extractor, retriever, candidates), scorers, matcher, cache, where)
    calls = [partial(scoring.score, sequence, watch) for sequence in dataset.sequences]
    of_cohort = [] if cohort is None else [partial(scoring.score_cohort, cohort, watch)]
    scored: list[Scored] = together(*of_cohort, *calls)
    strengths = scoring.hubness(*scored.pop(0)) if of_cohort else {}
    ranked = [rank_sequence(*result, fused, correlated, ties, hubness=strengths) for result in scored]
    matched = [sequence for sequence, _ in scored]
    for line in score_warnings(matched, ranked, scorers):
        cache.warn(line)
    systems = {name: [by_system[name] for by_system in ranked] for name in ranked[0]}
    return Result(dataset, matched, systems, watch.seconds)


@dataclass(frozen=True)
class _Scoring:
    """Arguments of `evaluate` that determine matches and scores."""

    dataset: Dataset
    tools: tuple[Extractor | Source, Retriever, int | Literal["all"]]  # the number of candidates last
    scorers: Mapping[str, Scorer]
    matcher: Matcher
    cache: FeatureCache
    where: Mapping[str, Any]  # `memory` and `devices`

    def score(self, sequence: QuerySequence, watch: Stopwatch, label: str = "") -> Scored:
        """Match and score a sequence."""
        track = {"track": self.cache.track(f"{label}matching")} if label else {}
        options = {"matcher": self.matcher, "cache": self.cache, "watch": watch, **self.where, **track}
        matched = match_sequence(self.dataset, sequence, *self.tools, **options)
        options = {"devices": self.where["devices"], "track": self.cache.track(f"{label}scores")}
        with watch("scores"):
            return matched, stages.score(self.scorers, matched.by_scale, matched.candidates, **options)

    def score_cohort(self, cohort: int, watch: Stopwatch) -> Scored:
        """Match and score the database with itself, as a stage of its own."""
        sequence = cohort_sequence(self.cache.contents(self.dataset.database), cohort)
        with watch(COHORT):
            return self.score(sequence, Stopwatch(), "cohort ")

    def hubness(self, matched: Matched, scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Hubness `[N]` of the database images by name of the scorer, from the matches and scores of the cohort."""
        size = len(self.dataset.database)
        return {name: hubness(matched.candidates, values, size, name=name) for name, values in scores.items()}
