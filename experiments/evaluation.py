"""The main job: images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experiments import build, confidences, distributed_launch, run_folder, sharding, stages, truth
from experiments.settings import SettingsError
from experiments.stages import Images, Tools
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import differences
from mfvpr.datasets.truth import Unit
from mfvpr.evaluation import evaluation
from mfvpr.features import Source
from mfvpr.report import runs
from mfvpr.report.confidences import Assured, confidence_figures, confidence_table, write_confidence
from mfvpr.report.differences import write_gains
from mfvpr.report.evaluations import Figure, Judged, figures, recall_table, write_rankings, write_skipped
from mfvpr.report.shifts import write_shifts
from mfvpr.reranking.results import COHORT, FILTER, FRAMES
from mfvpr.scoring import HistogramOfShifts
from mfvpr.storage import NotYet
from mfvpr.storage.feature_writers import open_sinks
from mfvpr.utils import Stopwatch
from mfvpr.utils.versions import versions

_THRESHOLDS: dict[Unit, str] = {"frames": "tolerance", "m": "radius"}  # their names in results


@dataclass(frozen=True)
class Outcome:
    """Everything that one evaluation made; parameters by system, and the histogram where it decides."""

    settings: dict[str, Any]
    images: Images
    tools: Tools
    judged: Judged
    assured: Assured
    parameters: dict[str, dict[str, Any]]
    histogram: HistogramOfShifts | None
    figures: list[Figure]


def evaluate(settings: dict[str, Any]) -> None:
    """Every stage, the table, a run folder with its page; of a shard, what it can do by now."""
    if settings["shard"] is None:
        with run_folder.claimed(settings) as folder:
            _leave(folder, evaluated(settings))
        return
    with sharding.joined(settings):
        try:
            outcome = evaluated(settings)
        except NotYet as needs:
            sharding.wait(settings, needs)
            done, then = ("what it can", "start it again when they are there")
            if needs.is_complete:
                done, then = ("its part", "the last shard leaves the results")
            print(f"shard {settings['shard']} has done {done}: {needs}; {then}")
            return
        distributed_launch.disconnect()
        with sharding.last(settings) as is_last:
            if is_last:
                with run_folder.claimed(settings, own=True, beside=[sharding.SHARDS]) as folder:
                    _leave(folder, outcome)
            else:
                print(f"shard {settings['shard']} is complete; results: {settings['out']}")
        sharding.complete(settings)


def _leave(folder: Path, outcome: Outcome) -> None:
    run_folder.leave(
        folder, outcome.settings, ground_truth(outcome), text=text(outcome),
        write=lambda new: write(new, outcome), figures=outcome.figures,
    )  # fmt: skip
    run_folder.report(folder)


def evaluated(settings: dict[str, Any]) -> Outcome:
    """The filter, each scorer, alone and with a cohort, and the best (the paper: histogram) with the filter."""
    scorers, watch, confidence = build.scorers(settings["scorer"]), Stopwatch(), confidences.read(settings)
    fusion, main = build.fusion(settings), "histogram" if "histogram" in scorers else next(iter(scorers))
    fusion.check(main, scorers)
    tools, images = stages.begun(settings, watch)
    sharding.check_data(settings, images)
    shown = asked_figures(settings["figures"], images.dataset)
    combined, histogram = fusion.system(main), scorers.get("histogram")
    headline, frames = combined if settings["final"] == "combined" else main, build.frames(settings)
    cohort, alone = settings["cohort"], [main]
    if cohort is not None and fusion.members(main) == [main]:
        alone.append(f"{main} + {COHORT}")
    fusions = {name: fusion.renamed(main, name) for name in alone}
    confidence = confidences.check(confidence, headline, settings, images)
    result = evaluation.evaluate(
        images.dataset, tools.extractor, tools.filter, scorers, candidates=settings["candidates"],
        matching=tools.matching, fused=fusions, cohort=cohort,
        correlated={headline: frames} if frames else {}, ties=settings["ties"], archive=tools.archive, watch=watch,
        **tools.where,
    )  # fmt: skip
    own, members = build.described(settings["scorer"]), fusion.members(main)
    if cohort is not None:
        own |= {f"{name} + {COHORT}": values | {"cohort": cohort} for name, values in own.items()}
    of_members = own[main] if members == [main] else {name: own[name] for name in members}
    fused = {
        how.system(name): (of_members if name == main else own[name]) | settings["fusion"]
        for name, how in fusions.items()
    }
    parameters = {FILTER: {}, **own, **fused}
    if frames:
        parameters[f"{headline} + {FRAMES}"] = parameters[headline] | asdict(frames)
    thresholds = truth.thresholds(settings, images.dataset.sequences[0].truth)
    judged = Judged(result, thresholds, sorted(set(settings["recall"]["ks"])), headline)
    histogram = histogram if isinstance(histogram, HistogramOfShifts) else None
    assured = Assured(judged, confidence and confidence.systems, settings["threshold"])
    drawn = figures(judged, tools.extractor, shown, assured.refused_of_headline, histogram)
    drawn += confidence_figures(assured) if shown else []
    deciding = histogram if main == "histogram" else None
    return Outcome(settings, images, tools, judged, assured, parameters, deciding, drawn)


def ground_truth(outcome: Outcome) -> dict[str, Any]:
    """What the recall refers to."""
    dataset, thresholds = outcome.images.dataset, outcome.judged.thresholds
    return truth.description(outcome.settings, dataset) | {"fingerprint": truth.fingerprint(dataset, thresholds)}


def text(outcome: Outcome) -> str:
    """For the terminal: what was evaluated, and the table."""
    tables = [recall_table(outcome.judged)] if outcome.judged.thresholds else []
    if tables and outcome.settings["confidence"]:
        tables.append(confidence_table(outcome.assured))
    return "\n".join([f"{heading(outcome)}\n", *(table.text() for table in tables)])


def heading(outcome: Outcome) -> str:
    """One line that says what was evaluated."""
    settings, dataset, matched = outcome.settings, outcome.images.dataset, outcome.judged.result.matched
    queries = sum(len(sequence.images) for sequence in dataset.sequences)
    bad_queries = sum(len(one.bad_queries) for one in matched)
    bad_database = len({row for one in matched for row in one.bad_database})
    matching = settings["matching"]
    check = f"cross_check={matching['cross_check']}" if "cross_check" in matching else matching["name"]
    check = "" if check == "cross_check=mutual" else f", {check}"
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {queries} queries{several}{_skipped(bad_queries)}, "
        f"{len(dataset.database)} database images{_skipped(bad_database)}, "
        f"{_num_candidates(outcome)} candidates ({settings['retrieval']['name']}), "
        f"{settings['features']['name']} features{check}; {truth.in_words(truth.description(settings, dataset))}"
    )


def _skipped(number: int) -> str:
    return f" ({number} skipped)" if number else ""


def write(folder: Path, outcome: Outcome) -> None:
    """All files of a run folder but the figures."""
    runs.write_json(folder / "results.json", result_rows(outcome))
    if outcome.judged.thresholds:
        runs.write_table(folder, recall_table(outcome.judged), heading(outcome))
    write_rankings(folder, outcome.judged, outcome.assured.refused_of_headline)
    write_gains(folder, outcome.judged)
    write_confidence(folder, outcome.assured, confidences.made(outcome.settings, outcome.images, outcome.judged))
    if outcome.histogram is not None:
        write_shifts(folder, outcome.judged, outcome.histogram, outcome.assured.refused_of_headline)
    write_skipped(folder, outcome.judged.result)


def result_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """One row per system and threshold, and sequence where there are several."""
    judged, settings, dataset = outcome.judged, outcome.settings, outcome.images.dataset
    common = {
        "filter": settings["retrieval"],
        "features": settings["features"],
        "matching": settings["matching"],
        "candidates": _num_candidates(outcome),
        "queries": sum(len(sequence.images) for sequence in dataset.sequences),
        "database": len(dataset.database),
        "dataset": dataset.name,
        "incomplete": list(differences(dataset)),
        "data_fingerprint": outcome.images.fingerprints,
        "ground_truth": ground_truth(outcome),
        "reading": outcome.images.reading,
        "bytes_per_image": _bytes_per_image(outcome),
        "seconds": judged.result.seconds,
        "versions": versions(),
    }
    rows = []
    for name, parameters in outcome.parameters.items():
        scorers = [part for part in name.split(" + ") if part not in (COHORT, FILTER, FRAMES)]
        decides = name == judged.headline
        system = {"system": name, "scorer": " + ".join(scorers) or "none", "decides": decides, "parameters": parameters}
        rows += [system | judgment | common for judgment in _judgments(judged, name)]
    return rows


def _bytes_per_image(outcome: Outcome) -> int | None:
    """The forecast of what an image's features take on disk; None where they are imported, and not kept."""
    extractor = outcome.tools.extractor
    if isinstance(extractor, Source):
        return None
    return sum(sink.forecast(1) for sink in open_sinks(None, extractor, {}, num_images=1))


def _judgments(judged: Judged, system: str) -> list[dict[str, Any]]:
    """Threshold, and recall by K; of several sequences, each, and their means."""
    if not judged.thresholds:
        return [{"recall_at": {}}]
    known = judged.sequences[0].truth
    name = _THRESHOLDS.get(known.unit) if known else None
    several = len(judged.sequences) > 1
    return [
        ({"sequence": sequence} if several else {})
        | ({name: threshold} if name else {})
        | {"recall_at": {str(k): round(float(value), 6) for k, value in zip(judged.ks, recall[place], strict=True)}}
        for sequence, recall in judged.parts(system)
        for place, threshold in enumerate(judged.thresholds)
    ]


def _num_candidates(outcome: Outcome) -> int:
    return int(outcome.judged.result.matched[0].candidates.indices.shape[1])


def asked_figures(asked: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """How many figures, or of which queries, as rows; what is asked for may be names."""
    if isinstance(asked, int):
        return asked
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(one, -1) if isinstance(one, str) else one for one in asked]
    for one, row in zip(asked, rows, strict=True):
        if not 0 <= row < len(names):
            raise SettingsError(
                f"figures=[{one}]: expected rows of queries from 0 to {len(names) - 1}, or names such as "
                f"{dataset.queries.names[0]}"
            )
    return list(dict.fromkeys(rows))
