"""Where systems differ: for every query whether each is right, and for every two of them whether that is luck."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mfvpr.datasets.positives import stacked
from mfvpr.evaluation.paths import places_along_path
from mfvpr.evaluation.statistics import McNemar, SignFlips, block_sign_flips, mcnemar
from mfvpr.report.evaluations import Judged
from mfvpr.report.rankings import number, write_csv
from mfvpr.report.tables import Table
from mfvpr.utils.files import write_text


class Difference(NamedTuple):
    """Two systems on all queries of all sequences, by their first answers."""

    first: str
    second: str
    mcnemar: McNemar
    sign_flips: SignFlips


def differences(judged: Judged) -> list[Difference]:
    """Of every two systems, in their order; none without ground truth."""
    if not judged.thresholds:
        return []
    places = range(len(judged.sequences))
    hits = {name: np.concatenate([_right(judged, name, place)[:, 0] for place in places])
            for name in judged.result.systems}  # fmt: skip
    shown = _places(judged)
    return [
        Difference(first, second, mcnemar(hits[first], hits[second]),
                   block_sign_flips(hits[first], hits[second], places=shown))
        for first, second in itertools.combinations(hits, 2)
    ]  # fmt: skip


def _places(judged: Judged) -> np.ndarray | None:
    """`[Q]` of the one map that all queries are of; None where these are one sequence, in the order of its path."""
    truth, right = judged.sequences[0].truth, [one for one in judged.right if one is not None]
    if truth is None or (len(judged.sequences) == 1 and truth.unit != "m"):
        return None
    return places_along_path(stacked(right), truth.unit)


def differences_table(judged: Judged) -> Table:
    """System x system: how many queries only that of the row gets right, and p by blocks of the path.

    Of several sequences of one database, blocks are of its places.
    """
    cells = {}
    for first, second, counts, flips in differences(judged):
        cells[first, second] = f"{counts.only_first} (p {flips.p_value:.2g})"
        cells[second, first] = f"{counts.only_second} (p {flips.p_value:.2g})"
    names = [*judged.result.systems]
    rows = [[name, *(cells.get((name, other), "") for other in names)] for name in names]
    return Table(["only this is right, not", *names], rows)


def write_gains(folder: Path, judged: Judged) -> None:
    """`gains.csv` of every sequence, where its predictions are, and of all `differences.csv` and `differences.md`.

    Nothing is written without ground truth. `place` in `gains.csv` is where along the map each query is: intervals and
    tests across runs need to know whose neighbor it is. It is the row of the query where that is the order of the path.
    """
    if not judged.thresholds:
        return
    columns = [column for name in judged.result.systems for column in (name, f"{name} rank")]
    shown = _places(judged)
    sizes = [len(sequence.images) for sequence in judged.sequences]
    along = range(sum(sizes)) if shown is None else shown.tolist()
    for place, start in enumerate(np.cumsum([0, *sizes[:-1]])):
        lines = _gains(judged, place, along[start : start + sizes[place]])
        write_csv(judged.folder(folder, place) / "gains.csv", ["query", "place", *columns], lines)
    write_csv(
        folder / "differences.csv",
        ["system", "other", "only_system", "only_other", "mcnemar_p", "block", "blocks", "blocks_p"],
        [[first, second, counts.only_first, counts.only_second, *(number(value) for value in (
            counts.p_value, flips.block, flips.blocks, flips.p_value))]
         for first, second, counts, flips in differences(judged)],
    )  # fmt: skip
    write_text(folder / "differences.md", differences_table(judged).markdown())


def _gains(judged: Judged, place: int, along: Sequence[int]) -> Iterator[list[str | int]]:
    """By query: for every system whether its first answer is right, and the rank of the first right one."""
    right = [_right(judged, system, place) for system in judged.result.systems]
    for query, name in enumerate(judged.sequences[place].images.names):
        line: list[str | int] = [name, along[query]]
        for answers in (one[query] for one in right):
            line += [int(answers[0]), int(np.argmax(answers)) + 1 if answers.any() else ""]
        yield line


def _right(judged: Judged, system: str, place: int) -> np.ndarray:
    """`[Q, C]` bool in the order of a system's ranking, with ground truth."""
    return np.asarray(judged.is_right(system, place), bool)
