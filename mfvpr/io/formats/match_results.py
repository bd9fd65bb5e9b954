"""Read the results of an image matcher that To-Match stores with torch, as plain data and without PyTorch."""

import io
import zipfile
from pathlib import Path

from mfvpr.io.containers import reading
from mfvpr.io.formats.numpy_objects import ArrayUnpickler
from mfvpr.io.formats.pickles import natural_number, of_type
from mfvpr.utils.errors import InputError

_KEY = "num_inliers"


def read_num_inliers(path: Path) -> list[int]:
    """Numbers of inliers of a query with its predictions, in their order.

    The file is a zip file with a pickle: a list with a dictionary for each prediction. Only `num_inliers` is used.

    Raises:
        InputError: the file is damaged, or holds other content.
    """
    with reading(path, mend="expected results of To-Match's match_queries_preds.py"):
        with zipfile.ZipFile(path) as archive:
            [entry] = (entry for entry in archive.infolist() if entry.filename.split("/")[1:] == ["data.pkl"])
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise InputError("expected an uncompressed entry data.pkl, as torch writes it, got another")
            content = ArrayUnpickler(io.BytesIO(archive.read(entry))).load()
        results = of_type(list, content)
        if not all(_KEY in of_type(dict, result) for result in results):
            raise InputError(f"expected {_KEY} of each prediction, got results without")
        return [natural_number(result[_KEY]) for result in results]
