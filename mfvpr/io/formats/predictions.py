"""Read the predictions of VPR-methods-evaluation, and To-Match's results of matching them, without PyTorch.

A folder has a text file for each query, and beside it a `.torch` file with a result for each prediction.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mfvpr.io.containers import reading
from mfvpr.io.formats.numpy_objects import ArrayUnpickler
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader
from mfvpr.io.formats.pickles import natural_number, of_type
from mfvpr.io.formats.result_files import plain_parts, result_matches
from mfvpr.io.formats.torch_archives import open_torch_archive
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
        raise InputError(f"{path}: expected one path below {QUERY!r}, and one or more below {PREDICTIONS!r}, as "
                         "VPR-methods-evaluation writes them")  # fmt: skip
    return parts[QUERY][0], parts[PREDICTIONS]


def read_num_inliers(path: Path) -> list[float]:
    """Numbers of inliers of a query with its predictions, in their order; raises as `_read_results`."""
    results = _read_results(path)
    with reading(path, mend=_MEND):
        if not all(_INLIERS in result for result in results):
            raise InputError(f"expected {_INLIERS} of each prediction, got results without")
        return [float(natural_number(result[_INLIERS])) for result in results]


class PredictionPairs(PairReader):
    """Reader of a folder of predictions and their results; matches are points in To-Match's resized images."""

    by_number, in_image_files = False, False

    def __init__(self, path: Path, verified: bool = False) -> None:
        self.path, self._verified = path, verified
        self._places: dict[Pair, tuple[Path, int]] = {}
        for file in sorted(path.glob("*.torch")):
            query, predictions = read_predictions(file.with_suffix(".txt"))
            for position in range(len(_read_results(file))):
                if position >= len(predictions):
                    raise InputError(f"{file}: expected results of at most {len(predictions)} predictions, as in the "
                                     "text file, got more; match the predictions of this run")  # fmt: skip
                self._places.setdefault((query, predictions[position]), (file, position))
        self.images = tuple(dict.fromkeys(name for pair in self._places for name in pair))
        self.has_confidences = self.find_confidences([*self._places])

    @staticmethod
    def fits(folder: Path) -> bool:
        """Whether a folder has results beside predictions."""
        return any(file.with_suffix(".txt").exists() for file in folder.glob("*.torch"))

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._places

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        results: tuple[Path, list[dict[Any, Any]]] | None = None  # of the last file: pairs of a query share one
        for pair in pairs:
            file, position = self._places[pair]
            if results is None or results[0] != file:
                results = file, _read_results(file)
            with reading(file, mend=_MEND):
                parts = plain_parts(results[1][position])
            yield result_matches(file, parts, self._verified)


def _read_results(path: Path) -> list[dict[Any, Any]]:
    """A dictionary for each prediction; an InputError if the file is damaged, or holds other content."""
    with (
        reading(path, mend=_MEND),
        path.open("rb") as file,
        open_torch_archive(file) as archive,
    ):
        return [of_type(dict, result) for result in of_type(list, ArrayUnpickler(archive.pickle).load())]
