"""Read the predictions of VPR-methods-evaluation, and To-Match's results of matching them, without PyTorch.

A folder has a text file for each query, and beside it a `.torch` file with a result for each prediction.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mfvpr.io.containers import reading
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader
from mfvpr.io.formats.result_files import read_torch_result, result_matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable

QUERY, PREDICTIONS, POSITIVES = "Query path:", "Predictions paths:", "Positives paths:"  # headings
_INLIERS = "num_inliers"
_MEND = "expected results of To-Match's match_queries_preds.py"


def read_predictions(path: Path) -> tuple[str, list[str]]:
    """Paths of a query and its predictions. Positives are not read: the data set has its own ground truth."""
    with reading(path, mend="expected a text file of predictions"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    parts: dict[str, list[str]] = {heading: [] for heading in ("", QUERY, PREDICTIONS, POSITIVES)}
    heading = ""
    for line in filter(None, map(str.strip, text.split("\n"))):
        if line in parts:
            heading = line
        else:
            parts[heading].append(printable(line))
    if parts[""] or len(parts[QUERY]) != 1 or not parts[PREDICTIONS]:
        raise InputError(
            f"{path}: expected one path below {QUERY!r}, and one or more below {PREDICTIONS!r}, as "
            "VPR-methods-evaluation writes them"
        )
    return parts[QUERY][0], parts[PREDICTIONS]


def read_num_inliers(path: Path) -> list[float]:
    """Numbers of inliers of a query with its predictions, in their order; raises as `_read_results`."""
    counts: list[Any] = [result.get(_INLIERS) for result in _read_results(path)]
    if not all(type(count) is int and 0 <= count < 2**31 for count in counts):
        raise InputError(f"{path}: expected {_INLIERS} of each prediction, a whole number from 0; {_MEND}")
    return list(map(float, counts))


class PredictionPairs(PairReader):
    """Reader of a folder of predictions and their results; matches are points in To-Match's resized images."""

    by_number, in_image_files = False, False

    def __init__(self, path: Path, verified: bool = False) -> None:
        self.path, self._verified = path, verified
        self._places: dict[Pair, tuple[Path, int]] = {}
        for file in sorted(path.glob("*.torch")):
            query, predictions = read_predictions(file.with_suffix(".txt"))
            results = _read_results(file)
            if len(results) > len(predictions):
                raise InputError(
                    f"{file}: expected results of at most {len(predictions)} predictions, as in the text file, got "
                    f"{len(results)}; match the predictions of this run"
                )
            for position, prediction in enumerate(predictions[: len(results)]):
                self._places.setdefault((query, prediction), (file, position))
        self.images = tuple(dict.fromkeys(name for pair in self._places for name in pair))

    @staticmethod
    def fits(folder: Path) -> bool:
        """Whether a folder has results beside predictions."""
        return any(file.with_suffix(".txt").exists() for file in folder.glob("*.torch"))

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._places

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        read_results = cache(_read_results)  # pairs of a query share a file
        for pair in pairs:
            file, position = self._places[pair]
            yield result_matches(file, read_results(file)[position], self._verified)


def _read_results(path: Path) -> list[dict[Any, Any]]:
    """A dictionary for each prediction; an InputError if the file is damaged, or holds other content."""
    results = read_torch_result(path, _MEND)
    if not isinstance(results, list) or not all(isinstance(result, dict) for result in results):
        raise InputError(f"{path}: expected a list of dictionaries; {_MEND}")
    return results
