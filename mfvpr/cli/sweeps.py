"""Sweeps of the parameters of a system, for users of the library; `sweeping` is the program."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mfvpr.core import Scorer
from mfvpr.core.scorer import numbers_by_name, static_names
from mfvpr.datasets import Dataset
from mfvpr.evaluation import EvaluationProtocol, Pipeline, System, evaluation_protocol, match_sequence
from mfvpr.evaluation.protocol import Split
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.report.runs import LAST
from mfvpr.report.sweeps import Sweep, axes_json
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.tuning.sweeps import Axes, DriveRanking, SweepOptions, search_grid
from mfvpr.utils import InputError, Runtime


def sweep(
    dataset: Dataset, system: System | Scorer, /, *, split: Split | None = None,
    thresholds: Sequence[float] | None = None, out: Path | str | None = None, cache: FeatureCache | None = None,
    runtime: Runtime | None = None, **axes: Sequence[Any],
) -> Sweep:  # fmt: skip
    """Rank with every combination of parameter values, and choose the best.

        sweep = mfvpr.sweep(data, MyScorer(), sigma=[5, 10, 22.5], weight=["fs", "ratio"], split="both", out="runs/s")
        sweep.best, sweep.interval, sweep.plot("sigma", "weight")
        print(sweep.table())

    Args:
        dataset: one query sequence with ground truth.
        system: its only scorer is swept, and fused with the retrieval if the system ranks by that. If it has a sequence
            of this ranking, the sequence ranks. Or a scorer, for the features and matches of `mfvpr sweep` (SIFT, VLAD,
            50 candidates).
        split: half of the path to choose on ("first_half", "second_half"), or "both" in turn; the result is reported
            on the other half. None = choose and report on all queries.
        thresholds: largest distances of a correct prediction, in the unit of the ground truth. The middle one decides.
            None = 1, 2 and 5 frames, or 25 m.
        out: folder of the result, also of the rankings by finished settings: the same call continues a sweep.
        cache: where features and matches are kept; None = in memory.
        runtime: devices, memory, progress and messages; None = those of the cache.
        axes: lists of values by parameter: fields of the scorer (words stand for weights, `inner.sigma` is passed as
            `**{"inner.sigma": [...]}`), `max_distance` of matches, and `c` of the fusion with the retrieval.

    Raises:
        InputError: an axis that the scorer does not have, no ground truth, a folder of something else, or images that
            cannot be used.
    """
    system = system if isinstance(system, System) else _default_system(system)
    name, scorer, c = _only_scorer(system)
    if clash := {*numbers_by_name(scorer), *static_names(scorer)} & {"split", "thresholds", "out", "cache", "runtime"}:
        raise InputError(f"{name}.{min(clash)}: mfvpr.sweep means something else by {min(clash)}; rename the field")
    if not axes:
        raise InputError("sweep: expected at least one axis, such as sigma=[5, 10, 22.5]")
    swept = Axes(scorer, axes if c is None else {"c": [c], **axes}, {} if c is None else {"c": c})
    sequence = dataset.only
    if sequence.truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth to choose by, got none")
    if thresholds is None:
        thresholds = sequence.truth.thresholds()
    protocol, cache = evaluation_protocol(sequence.truth, thresholds, split), cache or FeatureCache()
    runtime = runtime or cache.runtime
    kind = system.fused[name].retrieval_score if name in system.fused else "cosine"
    options = SweepOptions(
        ties=system.ties, retrieval_score=kind, sequence=_sequence(system, dataset, protocol),
        folder=_block_folder(out, swept), runtime=runtime,
    )  # fmt: skip
    matched = match_sequence(dataset, sequence, system.pipeline, cache=cache, runtime=runtime)
    result = Sweep(dataset.name, name, search_grid(swept, protocol, matched.by_scale, matched.candidates, options))
    if out is not None:
        result.save(out)
    return result


def _default_system(scorer: Scorer) -> System:
    sift = Sift()
    pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
    return System(pipeline, {getattr(scorer, "__name__", type(scorer).__name__): scorer})


def _only_scorer(system: System) -> tuple[str, Scorer, float | str | None]:
    """Name and value of the scorer, and the c of its fusion with the retrieval; None if the score alone ranks."""
    if len(system.scorers) == 1:
        [(name, scorer)] = system.scorers.items()
        if system.headline == name:
            return name, scorer, None
        fusion = system.fused.get(name)
        if system.headline == f"{name} + {RETRIEVAL}" and fusion and not fusion.weights:
            return name, scorer, fusion.c if isinstance(fusion.c, float | int) else "auto"
    raise InputError(f"system: expected one that ranks by its only scorer, alone or + {RETRIEVAL}, got one of "
                     f"{', '.join(system.scorers)} that ranks by {system.headline}; sweep one scorer at a time with "
                     "mfvpr.System(system.pipeline, {name: scorer})")  # fmt: skip


def _sequence(system: System, dataset: Dataset, protocol: EvaluationProtocol) -> DriveRanking | None:
    """The only sequence of the ranking that decides."""
    filters = system.sequences.get(system.headline, ())
    if len(filters) > 1:
        raise InputError(f"sequences: expected at most one of {system.headline}, got {len(filters)}; sweep each")
    return DriveRanking.of(filters[0], dataset, protocol) if filters else None


def _block_folder(out: Path | str | None, axes: Axes) -> Path | None:
    """The folder of finished blocks, in a new or empty folder or in one of this sweep; None without `out`."""
    if out is None:
        return None
    blocks = Path(out) / "blocks"
    if not blocks.is_dir() and Path(out).exists() and (not Path(out).is_dir() or any(Path(out).iterdir())):
        raise InputError(f"out={out}: expected a new or empty folder, or one of a sweep; name another")
    if (results := Path(out) / LAST).exists() and json.loads(results.read_text("utf-8"))["axes"] != axes_json(axes):
        raise InputError(
            f"out={out}: has the result of a sweep of other axes, which would be lost; name another folder"
        )
    blocks.mkdir(parents=True, exist_ok=True)
    return blocks
