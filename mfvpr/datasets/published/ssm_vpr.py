"""The data sets of SSM-VPR (Camara and Preucil, 2020), which the paper uses as well: two folders and a table."""

import re
from pathlib import Path, PurePosixPath

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence, image_folder
from mfvpr.datasets.truth_files import truth_from_file
from mfvpr.utils.errors import InputError

LAYOUT = """Reference/image0000.png (or .jpg), ...  the database, numbered from 0
Live/image0000.png (or .jpg), ...       the queries, numbered from 0
GroundTruth.csv                         Reference,Live and then a line per query: both numbers"""


def ssm_vpr(root: Path, name: str) -> Dataset:
    """Correct within a tolerance in frames of the database image in the table."""
    database, queries = (_numbered_images(root / side) for side in ("Reference", "Live"))
    truth = truth_from_file(root / "GroundTruth.csv", queries.names, database.names, widened=True)
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _numbered_images(folder: Path) -> ImageFolder:
    """Images with names that end in 0, 1, ..., the numbers in the table."""
    images = image_folder(folder)
    for row, name in enumerate(images.names):
        digits = re.search(r"(\d+)$", PurePosixPath(name).stem)
        if digits is None or int(digits[1]) != row:
            raise InputError(f"{folder}: expected images numbered from 0 without gaps, got {name} in place {row}; get "
                             "the whole data set")  # fmt: skip
    return images
