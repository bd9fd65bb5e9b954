"""The whole way in one call: images -> features -> shortlist -> matches -> scores -> ranking -> recall.

    sift = Sift()
    result = mfvpr.evaluate(dataset, sift, Retrieval(Aggregated(sift, VladFitting())),
                            {"histogram": mfvpr.HistogramOfShifts()}, candidates=50)
    print(result.recall([0.0])["histogram"].pooled)

Features, shortlist and matches are kept in an archive, where that has a folder.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from mfvpr import pipeline
from mfvpr.archive import Archive
from mfvpr.checks import check_request, nan_scores
from mfvpr.cohort import cohort_sequence, hubness
from mfvpr.data.datasets import Dataset, QuerySequence
from mfvpr.features import Extractor, Source
from mfvpr.filters import Filter
from mfvpr.frame_correlation import FrameCorrelation
from mfvpr.matchers import NEIGHBORS, Matcher
from mfvpr.numerics import Device
from mfvpr.progress import Stopwatch
from mfvpr.rankings import Fusion, rank_sequence
from mfvpr.reranking import Ties
from mfvpr.results import COHORT, Matched, Result
from mfvpr.scoring import Scorer
from mfvpr.sequence_matching import match_sequence, matches_recipe
from mfvpr.shards import together
from mfvpr.stores.manifest import SCORES, store_path
from mfvpr.stores.scores import open_score_store

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
        extractor: what takes local features from images, or has them, see `mfvpr.imported`.
        filter: what finds candidates.
        scorers: by name.
        candidates: that the filter proposes for each query.
        matching: what matches a pair, see `mfvpr.Matcher`.
        fused: scorers, by name, that are ranked together with the filter's score as well, as `name + filter`, or with
            other scorers' and the filter's, as `name + other + filter`; see `mfvpr.rankings.Fusion`.
        correlated: scorers and those that are fused, by name, that are ranked by their scores with frame correlation as
            well, as `name + frames`.
        cohort: all scorers are ranked with a cohort as well, as `name + cohort`: database images that score high with
            other places lose as much (`mfvpr.cohort`). The number says how many frames on both sides of an image show
            its place, and are left out; None = no cohort.
        ties: equal scores keep the order of the filter, or go by the row of the database: "filter", "index".
        archive: where features and matches are kept; None = in memory.
        memory: GB that features of the database may take on the devices, and matches that are kept in memory; None = a
            third of what is free.
        devices: that share the queries; None = the one that JAX takes.
        watch: gets the seconds of the stages; all that a cohort takes is a stage of its own.

    Raises:
        InputError: arguments, images, stores or features that cannot be used, or what an extractor, a filter or a
            scorer gives; one line says which, and the mend.
        NotYet: the archive is that of a shard, which has done its part, and others have not: see `mfvpr.shards`.
    """
    fused, correlated = fused or {}, correlated or {}
    check_request(scorers, fused, correlated, ties, memory, cohort=cohort is not None)
    archive, watch = archive or Archive(), watch or Stopwatch()
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
    tools: tuple[Extractor | Source, Filter, int | Literal["all"]],
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
            return pipeline.score(scorers, matched.by_scale, matched.candidates, devices=how["devices"], track=track)

    if archive.shard is None or archive.root is None:
        matched = match()
        return matched, score(matched)
    made = matches_recipe(dataset, sequence, *tools, how["matching"], archive)
    recipe = {"matches": made, "scorers": archive.recipe_of(dict(scorers))}
    names, path = sequence.images.names, store_path(archive.root, "scores", recipe, SCORES)
    with open_score_store(path, recipe, num_queries=len(names), **archive.store_options) as store:
        own = archive.shard.rows(names)
        missing = [row for row in own if not store.done[row]]
        # One without queries has images to take; and what is done together, all must do or none.
        if missing or not own or (archive.shard.meets and not store.done.all()):
            part = match(own)
        if missing:  # all are scored, so that what goes on has the bits of one run
            scores = np.stack([*score(part).values()], axis=1)
            store.write({row: scores[own.index(row)] for row in missing})

        def lacking() -> Sequence[int]:
            store.look()
            return np.flatnonzero(~store.done).tolist()

        archive.shard.wait(lacking, names, f"{sequence.name} scores", patience=archive.patience, is_complete=True)
        by_query = np.stack([scores for _, scores in store.read()])
    return match(), dict(zip(scorers, np.moveaxis(by_query, 1, 0), strict=True))


def _scored_cohort(
    dataset: Dataset, others: QuerySequence, tools: Any, scorers: Any, watch: Stopwatch, **how: Any
) -> Scored:
    """Of the database among itself: a stage of its own."""
    with watch(COHORT):
        return _scored(dataset, others, tools, scorers, Stopwatch(), label="cohort ", **how)
