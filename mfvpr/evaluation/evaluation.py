"""All stages in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())), candidates=50)
    ranked = rank_dataset(dataset, System(pipeline, {"histogram": mfvpr.HistogramOfShifts()}))
    print(ranked.recall([0.0])["histogram"].pooled)

`mfvpr.evaluate` does this for several data sets and systems, and reports.

Features, shortlist and matches are kept in the folder of a cache, if it has one.
"""

from dataclasses import replace

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.evaluation import stages
from mfvpr.evaluation.results import RankedDataset
from mfvpr.evaluation.sequence_matching import match_sequence
from mfvpr.evaluation.system import System
from mfvpr.evaluation.validation import score_warnings
from mfvpr.reranking.cohort_normalization import cohort_sequence, hubness
from mfvpr.reranking.fusion import rank_by_scores
from mfvpr.reranking.results import COHORT, Matched
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.compiled_programs import keep_compiled_programs
from mfvpr.utils.progress import Stopwatch
from mfvpr.utils.runtime import Runtime

Scored = tuple[Matched, dict[str, np.ndarray]]  # a sequence, and its scores [Q, C] by name of the scorer


def rank_dataset(
    dataset: Dataset, system: System, *, cache: FeatureCache | None = None, runtime: Runtime | None = None
) -> RankedDataset:
    """Rank every query's candidates by the retrieval, by every scorer, and by combined scores.

    Args:
        dataset: one database, one or more query sequences.
        system: finds, matches, scores and ranks candidates.
        cache: where features and matches are kept; None = in memory. With a folder, compiled programs stay on disk as
            well, see `mfvpr.utils.compiled_programs`.
        runtime: devices, memory, progress and messages; None = those of the cache.

    Returns:
        Rankings by name, and the seconds of each stage. Extraction always counts as `features`; a cohort is a stage of
        its own.

    Raises:
        InputError: images, stores or features that cannot be used, or an invalid result of an extractor, the retrieval
            or a scorer; one line says which, and how to fix it.
    """
    watch, cache = Stopwatch(), cache or FeatureCache()
    cache = replace(cache, runtime=runtime or cache.runtime, watch=watch)
    if cache.root is not None:
        keep_compiled_programs()
    strengths, size = dict[str, np.ndarray](), len(dataset.database)
    if system.cohort is not None:
        cohort, values = _score_cohort(dataset, system, system.cohort, cache, watch)
        strengths = {name: hubness(cohort.candidates, values[name], size, name=name) for name in values}
    scored = [_score(dataset, sequence, system, cache, watch) for sequence in dataset.sequences]
    ways = system.final_scores.values(), system.ties
    ranked = [rank_by_scores(matched.candidates, scores, *ways, hubness=strengths) for matched, scores in scored]
    matched = [sequence for sequence, _ in scored]
    for line in score_warnings(matched, ranked, system.scorers):
        cache.warn(line)
    systems = {name: [by_system[name] for by_system in ranked] for name in ranked[0]}
    return RankedDataset(dataset, system, matched, systems, watch.seconds)


def _score(dataset: Dataset, sequence: QuerySequence, system: System, cache: FeatureCache, watch: Stopwatch) -> Scored:
    """Match and score a sequence."""
    matched = match_sequence(dataset, sequence, system.pipeline, cache=cache, watch=watch)
    with watch("scores"):
        return matched, stages.score(system.scorers, matched.by_scale, matched.candidates, runtime=cache.runtime)


def _score_cohort(dataset: Dataset, system: System, cohort: int, cache: FeatureCache, watch: Stopwatch) -> Scored:
    """Match and score the database with itself, as a stage of its own."""
    sequence = cohort_sequence(cache.recipes.contents(dataset.database), cohort)
    progress = cache.runtime.progress
    cache = replace(cache, runtime=replace(cache.runtime, progress=lambda label: progress(f"cohort {label}")))
    with watch(COHORT):
        return _score(dataset, sequence, system, cache, Stopwatch())
