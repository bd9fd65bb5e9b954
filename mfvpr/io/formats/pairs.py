"""Common interface of files with matches of image pairs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Num

Size = tuple[float, float]  # (width, height), px
Pair = tuple[str, str]  # names of two images in a file


class FileMatches(NamedTuple):
    """Matches of one pair as a file has them.

    first, second: `[M]` numbers of keypoints, or `[M, 2]` (x, y), px.
    confidence: None = the file has none.
    sizes: of the images that the points are in; None = the file does not tell.
    """

    first: Num[np.ndarray, "matches ..."]
    second: Num[np.ndarray, "matches ..."]
    confidence: Num[np.ndarray, " matches"] | None = None
    sizes: tuple[Size, Size] | None = None

    def exchanged(self) -> "FileMatches":
        """Matches of the same images in the other order."""
        sizes = None if self.sizes is None else (self.sizes[1], self.sizes[0])
        return FileMatches(self.second, self.first, self.confidence, sizes)


class PairReader:
    """Base class of readers of matches; a pair of names has an order.

    Attributes:
        path: file or folder, for messages.
        images: their names in the file.
        by_number: whether matches are numbers of keypoints.
        sided: whether the first name of a pair is always the query's, so that a name may also be a database image's.
        in_image_files: whether points without sizes are in the px of the image files.
    """

    path: Path
    images: tuple[str, ...]
    by_number: bool
    sided: bool = False
    in_image_files: ClassVar[bool] = True

    def __contains__(self, pair: Pair) -> bool:
        """Whether the file has the matches of a pair in this order; they may be none."""
        raise NotImplementedError

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        """Matches of pairs that the file contains."""
        raise NotImplementedError

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"] | None:
        """Keypoints (x, y) of an image, px, pixel centers at whole numbers (but see kapture); None = no keypoints."""
        return None

    def image_size(self, image: str) -> Size | None:
        """Size of an image; None = the file does not tell."""
        return None

    def spelling(self, name: str) -> str:
        """The name of an image in the spelling of the file."""
        return name
