"""Protocols of extractors and their results; descriptions of a folder's images, which threads decode meanwhile."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import jax
import numpy as np
from jaxtyping import Float, Num

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import Ignored, Interpolation, resize
from mfvpr.features.feature_set import FeatureSource, check_features, without_padding
from mfvpr.features.vlad import VladFitting
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import Track, no_progress, ordered_map

BORDER = 4  # px around ignored pixels, where filling them makes edges


class Scale(NamedTuple):
    """One scale of an extractor's local features."""

    dimension: int  # D of the descriptors
    typical_count: int  # usual number of features in an image
    weight: float = 1.0  # weight of the scale's score when the scores of several scales are fused


class Description(NamedTuple):
    """Global descriptor and local features of one image, as NumPy arrays."""

    vector: Float[np.ndarray, " dimensions"] | Float[np.ndarray, "vectors dimensions"] | None = None  # unit length
    local: tuple[Features, ...] = ()  # by scale, without padding (mask all True)

    @property
    def features(self) -> Features:
        """The features of the only scale; a `ValueError` if there are several scales, or none."""
        if len(self.local) != 1:
            raise ValueError(f"expected features of one scale, got {len(self.local)}; see `local`")
        return self.local[0]


def local_features(
    keypoints: Num[np.ndarray, "keypoints 2"],
    descriptors: Float[np.ndarray, "keypoints dimensions"],
    image_size: Sequence[int],
    scores: Float[np.ndarray, " keypoints"] | None = None,
) -> Features:
    """Features of one image without padding, from keypoints (x, y) px; scores are 1 by default."""
    size = np.array(image_size, np.float32)
    return Features.of(keypoints.astype(np.float32), descriptors, scores=scores, image_size=size)


@runtime_checkable
class Extractor(Protocol):
    """Images, uint8 RGB -> a Description of each.

    A cache on disk needs the `recipe` of an extractor of your own, see `mfvpr.utils.recipe_of`.

    Attributes:
        image_size: (width, height) that images are resized to, px.
        interpolation: of the resizing, see `mfvpr.datasets.image_reading.resize`.
        batch_size: images per call.
        vector_size: length of the global descriptor; 0 = no global descriptor.
        scales: of the local features; () = no local features.
    """

    @property
    def image_size(self) -> tuple[int, int]: ...

    @property
    def interpolation(self) -> Interpolation: ...

    @property
    def batch_size(self) -> int: ...

    @property
    def vector_size(self) -> int: ...

    @property
    def scales(self) -> tuple[Scale, ...]: ...

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptions of images of `image_size`; networks raise an `InputError` for images of another size."""
        ...


@runtime_checkable
class Source(Protocol):
    """Local features of folders of images that were extracted elsewhere, of one scale.

    `image_size` is that of the images that the keypoints are in, px; None = the size of the image files.
    """

    @property
    def image_size(self) -> tuple[int, int] | None: ...

    @property
    def interpolation(self) -> Interpolation: ...

    @property
    def scales(self) -> tuple[Scale, ...]: ...

    def open(self, folder: ImageFolder, *, partial: bool) -> FeatureSource:
        """The features of a folder's images; if `partial`, features of some images may be missing."""
        ...


@dataclass(frozen=True)
class Aggregated:
    """Global descriptors aggregated from local features, by a vocabulary that is fitted to the database."""

    extractor: Extractor | Source
    fitting: VladFitting


def describe_folder(
    folder: ImageFolder,
    extractor: Extractor,
    rows: Sequence[int],
    bad: dict[int, str],
    *,
    skip_bad: bool = False,
    track: Track = no_progress,
) -> Iterator[dict[int, Description]]:
    """Extract descriptions of the images in `rows`, by row, batch by batch.

    Images that are not used are added to `bad`, row -> reason: images whose description is not finite, and with
    `skip_bad` images that cannot be read. Without `skip_bad` these raise an `InputError`.
    """
    if extractor.batch_size < 1:
        raise InputError(f"batch_size={extractor.batch_size}: expected a whole number above 0")
    require_word("interpolation", extractor.interpolation, Interpolation)  # `load` would take it for a bad image

    def load(row: int) -> tuple[Num[np.ndarray, "_ _ 3"], Ignored | None] | InputError:
        try:
            image, ignored = folder.read_with_ignored(row)
            return resize(image, extractor.image_size, extractor.interpolation), ignored
        except InputError as error:
            return error

    def readable() -> Iterator[tuple[int, np.ndarray, Ignored | None]]:
        images = ordered_map(load, rows, workers=available_cpus())
        for row, image in zip(rows, track(images, len(rows)), strict=True):
            if not isinstance(image, InputError):
                yield row, *image
            elif skip_bad:
                bad[row] = str(image)
            else:
                raise InputError(f"{image}, or set on_bad_image=skip (Python: FeatureCache(skip_bad=True))")

    images = readable()
    while batch := list(itertools.islice(images, extractor.batch_size)):
        batch_rows, arrays, masks = zip(*batch, strict=True)
        descriptions = {}
        described = describe_images(np.stack(arrays), extractor)
        for row, ignored, description in zip(batch_rows, masks, described, strict=True):
            if description is None:
                bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
            else:
                descriptions[row] = without_ignored(description, ignored, extractor.image_size)
        yield descriptions


def without_ignored(description: Description, ignored: Ignored | None, size: tuple[int, int]) -> Description:
    """Drop keypoints in ignored pixels of an image, and within `BORDER` px of them at `size` (width, height) px."""
    if ignored is None:
        return description
    local, near = [], cv2.resize(ignored.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    near = cv2.dilate(near, np.ones((2 * BORDER + 1, 2 * BORDER + 1))) > 0
    for features in description.local:
        columns, rows = np.clip(np.rint(features.keypoints).astype(int), 0, np.subtract(size, 1)).T
        local.append(without_padding(replace(features, mask=~near[rows, columns])))
    return description._replace(local=tuple(local))


def describe_images(images: Num[np.ndarray, "images height width 3"], extractor: Extractor) -> list[Description | None]:
    """Extract descriptions of images of the extractor's size; None if a description is not finite."""
    name, dimensions = type(extractor).__name__, [scale.dimension for scale in extractor.scales]
    descriptions: list[Description | None] = []
    for description in (described := list(extractor(images))):
        if not isinstance(description, Description):
            got = type(description).__name__
            raise InputError(f"{name}: expected a Description, got {got}; return Description(vector, (features,))")
        vector, local = description
        for features in local:
            check_features(features, f"{name}: features", unit_length=False)
        if (got := [features.descriptors.shape[-1] for features in local]) != dimensions:
            raise InputError(f"{name}: expected local features of {dimensions} dimensions, as in `scales`, got {got}")
        if (size := 0 if vector is None else np.size(vector)) != extractor.vector_size:
            expected = f"a global descriptor of vector_size={extractor.vector_size} numbers"
            raise InputError(f"{name}: expected {expected}, got {size}; change either")
        unpadded = Description(vector, tuple(map(without_padding, local)))
        is_finite = all(np.isfinite(array).all() for array in jax.tree.leaves(unpadded))
        descriptions.append(unpadded if is_finite else None)
    if len(described) != len(images):
        raise InputError(f"{name}: expected a Description of each of {len(images)} images, got {len(described)}")
    return descriptions
