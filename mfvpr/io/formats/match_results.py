"""Read the results of an image matcher that To-Match stores with torch, as plain data and without PyTorch."""

from pathlib import Path

from mfvpr.io.containers import reading
from mfvpr.io.formats.numpy_objects import ArrayUnpickler
from mfvpr.io.formats.pickles import natural_number, of_type
from mfvpr.io.formats.torch_archives import open_torch_archive
from mfvpr.utils.errors import InputError

_KEY = "num_inliers"


def read_num_inliers(path: Path) -> list[int]:
    """Numbers of inliers of a query with its predictions, in their order.

    The file is a zip file with a pickle: a list with a dictionary for each prediction. Only `num_inliers` is used.

    Raises:
        InputError: the file is damaged, or holds other content.
    """
    with reading(path, mend="expected results of To-Match's match_queries_preds.py"), path.open("rb") as file:
        with open_torch_archive(file) as archive:
            results = of_type(list, ArrayUnpickler(archive.pickle).load())
        if not all(_KEY in of_type(dict, result) for result in results):
            raise InputError(f"expected {_KEY} of each prediction, got results without")
        return [natural_number(result[_KEY]) for result in results]
