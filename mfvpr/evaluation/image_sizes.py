"""Image sizes that follow the images: their shape, at a number of pixels.

An extractor has one image size. If `Pipeline.pixels` is set, the first image of the database decides, once.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress

from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.datasets.image_reading import read_size
from mfvpr.utils.errors import InputError

_SAME = 0.02  # relative difference of two aspect ratios that count as the same

Note = Callable[[str], object]
Size = tuple[int, int]  # (width, height), px


def size_for_images(size_for: Callable[[Size], Size], folders: Iterable[ImageFolder], note: Note) -> Size:
    """The image size for the shape of the first image, by `Pipeline.image_size_for`.

    `note` gets a line if images have another aspect ratio. Images that cannot be read do not count.
    """
    shapes = {folder.root / name: shape for folder in folders for name, shape in _shapes(folder)}
    if not shapes:
        raise InputError("image_size: expected images to take the shape from, got none that can be read")
    first = next(iter(shapes.values()))
    size = size_for(first)
    aspect = first[0] / first[1]
    other = [path for path, (width, height) in shapes.items() if abs(width / height / aspect - 1) > _SAME]
    if other:
        note(f"images are resized to {size[0]} x {size[1]} px, but {len(other)} of {len(shapes)} have another aspect "
             f"ratio than the first, such as {other[0]}: they are squashed")  # fmt: skip
    return size


def folders_of(dataset: Dataset) -> list[ImageFolder]:
    """The folders of a data set, the database first."""
    return [dataset.database, *(sequence.images for sequence in dataset.sequences)]


def _shapes(folder: ImageFolder) -> Iterable[tuple[str, Size]]:
    """Names and sizes (width, height) of the images that can be read."""
    for name, path in zip(folder.names, folder.paths, strict=True):
        with suppress(InputError):
            yield name, read_size(path, orient=folder.orient)
