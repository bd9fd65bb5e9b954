"""Differences between systems: hits of every query, and tests of every two systems."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mfvpr.datasets.positives import stack_positives
from mfvpr.evaluation.selection import places_along_path
from mfvpr.evaluation.statistics import McNemar, SignFlips, block_sign_flips, mcnemar
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.rankings import format_number, write_csv
from mfvpr.report.tables import Table
from mfvpr.utils.files import write_text


class Difference(NamedTuple):
    """Tests of two systems on the first predictions of all queries of all sequences."""

    first: str
    second: str
    mcnemar: McNemar
    sign_flips: SignFlips

    @property
    def cells(self) -> list[str]:
        """A line of `differences.csv`."""
        counts, flips = self.mcnemar, self.sign_flips
        numbers = map(format_number, (counts.p_value, flips.block, flips.blocks, flips.p_value))
        return [self.first, self.second, str(counts.only_first), str(counts.only_second), *numbers]


def differences(evaluation: EvaluationReport) -> list[Difference]:
    """Tests of every two systems, in their order; none without ground truth."""
    if not evaluation.thresholds:
        return []
    hits, places = {name: evaluation.hits(name) for name in evaluation.ranked.systems}, _places(evaluation)
    return [
        Difference(first, second, mcnemar(hits[first], hits[second]),
                   block_sign_flips(hits[first], hits[second], places=places))
        for first, second in itertools.combinations(hits, 2)
    ]  # fmt: skip


def _places(evaluation: EvaluationReport) -> np.ndarray | None:
    """`[Q]` places of all queries along the map; None for one sequence in the order of its path."""
    truth = evaluation.sequences[0].truth
    if truth is None or (len(evaluation.sequences) == 1 and truth.unit != "m"):
        return None
    known = [positives for positives in evaluation.positives if positives is not None]
    return places_along_path(stack_positives(known), truth.unit)


def _table(names: Sequence[str], tests: Sequence[Difference]) -> Table:
    """Table system x system: queries that only the system of the row predicts correctly, and p by blocks of the path.

    Blocks of several sequences are blocks of the database's places.
    """
    cells = {}
    for first, second, counts, flips in tests:
        cells[first, second] = f"{counts.only_first} (p {flips.p_value:.2g})"
        cells[second, first] = f"{counts.only_second} (p {flips.p_value:.2g})"
    rows = [[name, *(cells.get((name, other), "") for other in names)] for name in names]
    return Table(["only this is correct, not", *names], rows)


def write_gains(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, `differences.csv` and `differences.md`; nothing without ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need. It is
    the row of the query where that is the order of the path.
    """
    if not evaluation.thresholds:
        return
    systems, places = [*evaluation.ranked.systems], _places(evaluation)
    places = np.arange(sum(len(sequence.images) for sequence in evaluation.sequences)) if places is None else places
    header = ["query", "place", *(column for name in systems for column in (name, f"{name} rank"))]
    places_by_sequence = evaluation.by_sequence(places)
    for part, sequence in enumerate(evaluation.sequences):
        correct_by_system = [np.asarray(evaluation.is_correct(system, part), bool) for system in systems]
        lines = []
        for query, name in enumerate(sequence.images.names):
            cells: list[int | str] = []
            for correct in correct_by_system:
                rank = int(np.argmax(correct[query])) + 1 if correct[query].any() else ""
                cells += [int(correct[query, 0]), rank]
            lines.append([name, int(places_by_sequence[part][query]), *cells])
        write_csv(evaluation.folder(folder, part) / "gains.csv", header, lines)
    tests = differences(evaluation)
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "block", "blocks", "blocks_p"]
    write_csv(folder / "differences.csv", header, [test.cells for test in tests])
    write_text(folder / "differences.md", _table(systems, tests).markdown())
