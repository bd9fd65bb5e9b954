"""All stages in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())), candidates=50)
    ranked = rank_dataset(dataset, System(pipeline, {"histogram": mfvpr.HistogramOfShifts()}))
    print(ranked.recall([0.0])["histogram"].pooled)

`mfvpr.evaluate` does this for several data sets and systems, and reports.

Features, shortlist and matches are kept in the folder of a cache, if it has one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.metrics import count_correct
from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation import stages
from mfvpr.evaluation.fusion import rank_by_scores
from mfvpr.evaluation.rankings import Matched, Ranked
from mfvpr.evaluation.sequence_matching import match_sequence
from mfvpr.evaluation.system import System, folders_of
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.compiled_programs import keep_compiled_programs
from mfvpr.utils.errors import InputError
from mfvpr.utils.runtime import Runtime, Stopwatch

KS = (1, 5, 10)  # depths of recall, by default
Reason = Literal[  # why there is no place
    "no candidates",
    "overexposed",
    "blurred",
    "too few features",
    "too few matches",
    "no better than noise",
    "low confidence",
    "off the map",
]


@dataclass(frozen=True, repr=False)
class Recall:
    """Recall of one system, from numbers of correct queries and of all queries."""

    correct: Int[np.ndarray, "sequences tolerances ks"]
    queries: Int[np.ndarray, " sequences"]

    def __repr__(self) -> str:
        return f"Recall({np.round(self.pooled, 3).tolist()} over all queries, by threshold and k)"

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

    def __repr__(self) -> str:
        return f"RankedDataset({self.dataset!r} by {', '.join(self.systems)})"

    def positives(self, threshold: float) -> list[Positives]:
        """Positives at a threshold, by sequence; an InputError without a ground truth of all images."""
        if not threshold >= 0:
            raise InputError(f"threshold={threshold}: expected a number from 0")
        truths = [sequence.truth for sequence in self.dataset.sequences]
        if any(truth is None for truth in truths):
            raise InputError(f"{self.dataset.name}: there is no ground truth, so rankings only")
        positives = [truth.positives(threshold) for truth in truths if truth is not None]
        for sequence, truth in zip(self.dataset.sequences, positives, strict=True):
            expected, got = (len(sequence.images), len(self.dataset.database)), (len(truth), truth.num_database)
            if got != expected:
                words = "{} queries and {} database images".format
                raise InputError(f"{sequence.name}: expected a ground truth of {words(*expected)}, got {words(*got)}")
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
                [count_correct(ranking.rows, positives[sequence], ks) for positives in by_threshold]
                for sequence, ranking in enumerate(rankings)
            ]
            shape, queries = (len(rankings), len(by_threshold), len(ks)), [len(ranking.rows) for ranking in rankings]
            recalls[name] = Recall(np.array(correct, int).reshape(shape), np.array(queries))
        return recalls


def rank_dataset(
    dataset: Dataset, system: System, *, cache: FeatureCache | None = None, runtime: Runtime | None = None
) -> RankedDataset:
    """Rank every query's candidates by the retrieval, by every scorer, and by combined scores.

    Args:
        cache: where features and matches are kept; None = in memory. With a folder, compiled programs stay on disk as
            well, see `mfvpr.utils.compiled_programs`.
        runtime: devices, memory, progress and messages; None = those of the cache.

    Raises:
        InputError: images, stores or features that cannot be used, or an invalid result of an extractor, the retrieval
            or a scorer; one line says which, and how to fix it.
    """
    watch, cache = Stopwatch(), cache or FeatureCache()
    cache = replace(cache, runtime=runtime or cache.runtime, watch=watch)
    if cache.root is not None:
        keep_compiled_programs()
    system = system.fit_image_size(folders_of(dataset), cache.warn)
    systems = dict[str, list[Ranked]]()
    matched = [match_sequence(dataset, each, system.pipeline, cache=cache, watch=watch) for each in dataset.sequences]
    for sequence in matched:
        with watch("scores"):
            scores = stages.score(system.scorers, sequence.by_scale, sequence.candidates, runtime=cache.runtime)
        excluded = sequence.sequence.excluded if system.sequences else None
        rankings = rank_by_scores(
            sequence.candidates,
            scores,
            system.final_scores.values(),
            system.ties,
            num_rows=len(dataset.database),
            excluded=None if excluded is None else excluded.dense(),
        )
        for name, ranking in rankings.items():
            systems.setdefault(name, []).append(ranking)
    for name in system.scorers:
        stages.require_finite(name, np.concatenate([ranked.scores[ranked.rows >= 0] for ranked in systems[name]]))
    for number, sequence in enumerate(dataset.sequences):
        for name, rankings in systems.items():
            values = rankings[number].scores[rankings[number].rows >= 0]
            for words, is_bad in (("NaN, and rank last", np.isnan(values)), ("infinite", np.isinf(values))):
                if count := int(is_bad.sum()):
                    cache.warn(f"{sequence.name}: {count} scores of {name} are {words}")
    return RankedDataset(dataset, system, matched, systems, watch.seconds)
