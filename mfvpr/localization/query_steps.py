"""Steps of localizing one image: describe it, search candidates, match and score them, and read the shift."""

import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike

from mfvpr.core.batch import BIN_STEP, score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.scorer import Scorer, fit_capacities, require_scores
from mfvpr.core.types import Features, Matches
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import Ignored, fill_ignored, read_image, resize
from mfvpr.evaluation.stages import pair_shifts, require_finite
from mfvpr.features.extractor import Description, Extractor, describe_images, without_ignored
from mfvpr.features.feature_set import STEP, stack_features
from mfvpr.features.vlad import Vlad
from mfvpr.matchers.matcher import Matcher, match_pairs
from mfvpr.storage.cache_files import round_as_stored
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array, available_cpus, knows_own_context, round_up
from mfvpr.utils.runtime import ordered_map

_PAIRS_AT_ONCE = 8  # a scorer takes the time of so many, also for a single image of a rare size
_LEAST_SLOTS = 256  # of an image

Image = Path | str | bytes | ArrayLike
Described = tuple[Features, np.ndarray]
Pixels = UInt8[np.ndarray, "_ _ 3"]
Point = tuple[float, float]


def load(image: Image) -> Pixels:
    """Read an image file, or its bytes, or convert an array; an InputError if it is no image.

    Of 16 bits, the upper 8 are used; numbers of floating point are from 0 to 1, and opacity is left out.
    """
    if isinstance(image, str | os.PathLike):
        return read_image(image)
    if isinstance(image, bytes):
        with tempfile.NamedTemporaryFile() as file:
            file.write(image)
            file.flush()
            try:
                return read_image(file.name)
            except InputError as error:
                reason = str(error).replace(file.name, "image")
                raise InputError(f"image: expected the bytes of an image file, got {len(image)}: {reason}") from None
    pixels: Any = np.zeros(0)
    try:
        pixels = np.asarray(as_array(image))
        got = f"{list(pixels.shape)} {pixels.dtype}"
        pixels = pixels[..., None] if pixels.ndim == 2 else pixels
        pixels = np.repeat(pixels, 3, axis=2) if pixels.shape[2:] == (1,) else pixels
        pixels = pixels[..., :3] if pixels.shape[2:] == (4,) else pixels
        if pixels.dtype == np.uint16:
            pixels = (pixels >> 8).astype(np.uint8)
        elif pixels.dtype.kind == "f" and pixels.min(initial=0) >= 0 and pixels.max(initial=0) <= 1:
            pixels = np.rint(255 * pixels).astype(np.uint8)
    except Exception as error:  # other libraries raise any error, torch for tensors with gradients
        got = f"{type(image).__name__} ({' '.join(str(error).split())})"
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        expected = "a file, its bytes, or [H, W] gray or [H, W, 3] RGB of uint8, uint16 or floats from 0 to 1"
        raise InputError(f"image: expected {expected}, got {got}; convert it to a NumPy array")
    return pixels


@dataclass(frozen=True)
class Describing:
    """Extractors of a map; the features of queries are rounded as a store rounds the features of the map."""

    extractor: Extractor  # of local features of one scale
    describers: Sequence[Extractor | Vlad]  # of global descriptors, one behind the other; may be the same extractor

    def image(self, image: Image) -> Described:
        """Describe one image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts."""
        return self.pixels(load(image))[0]

    def pixels(self, pixels: Pixels, mask: Path | str | None = None) -> tuple[Described, Pixels]:
        """Describe one image without what a mask ignores; also return it at the size of the extractor."""
        pixels, ignored = (pixels, None) if mask is None else fill_ignored(pixels, Path(mask))
        networks = [each for each in self.describers if isinstance(each, Extractor) and each is not self.extractor]
        extractors, extract = [self.extractor, *networks], partial(self._extract, pixels, ignored)
        workers = min(len(extractors), available_cpus())
        extracted = ordered_map(extract, extractors, workers=workers) if workers > 1 and knows_own_context() else None
        (resized, description), *others = extracted or map(extract, extractors)
        features = round_as_stored(description.features)
        vectors, next_vectors = list[Any](), (described.vector for _, described in others)
        for each in self.describers:
            if isinstance(each, Vlad):
                vectors += [*each([features])]
            else:
                vectors.append(description.vector if each is self.extractor else next(next_vectors))
        if any(vector is None for vector in vectors):
            raise InputError("describer: gives no global descriptor; expected one that does, or VladFitting()")
        return (features, np.concatenate(vectors, axis=None, dtype=np.float32)), resized

    def _extract(self, pixels: Pixels, ignored: Ignored | None, extractor: Extractor) -> tuple[Pixels, Description]:
        """An image at the size of an extractor, and its description without what is ignored."""
        resized = resize(pixels, extractor.image_size, extractor.interpolation)
        [description] = describe_images(resized[None], extractor)
        if description is None:
            raise InputError("image: features are not finite (NaN or infinite)")
        return resized, without_ignored(description, ignored, extractor.image_size)

    def folder(self, images: ImageFolder, cache: FeatureCache) -> Iterator[dict[int, Described]]:
        """Describe the images of a folder that a cache lacks: batches by row. The cache may skip bad images."""
        [features] = cache.local(images, self.extractor)
        bad, size, vectors = {**features.bad}, self.extractor.batch_size, list[Any]()  # of all images, or functions
        for each in self.describers:
            described = cache.vectors(images, each, images) if isinstance(each, Extractor) else None
            vectors.append(described.values if described else each)
            bad.update(described.bad if described else {})
        if bad and not cache.skip_bad:
            raise InputError(bad[min(bad)])
        for reason in bad.values():
            cache.warn(reason)
        used = [row for row in range(len(images)) if row not in bad]
        for start in range(0, len(used), size):
            batch = dict(features.source.read(used[start : start + size]))  # also those without keypoints
            if cache.root is None:
                batch = {row: round_as_stored(local) for row, local in batch.items()}
            parts = [each([*batch.values()]) if isinstance(each, Vlad) else each[[*batch]] for each in vectors]
            values = np.concatenate(parts, axis=1, dtype=np.float32)
            yield dict(zip(batch, zip(batch.values(), values, strict=True), strict=True))


def nearest(
    vectors: Float[np.ndarray, "rows dimensions"],
    query: Float[np.ndarray, " dimensions"],
    number: int,
    among: Bool[np.ndarray, " rows"],
) -> tuple[Int[np.ndarray, " candidates"], Float[np.ndarray, " candidates"]]:
    """At most `number` rows and their products with the query, most similar first, then by row; none that are NaN.

    Rows that are not `among` the allowed ones are left out.
    """
    # Own threads: those of BLAS spin while they wait, which costs a third of the time.
    workers = available_cpus()
    parts = np.array_split(vectors, workers)
    products = np.concatenate([*ordered_map(partial(np.vecdot, query), parts, workers=workers)])
    rows = np.flatnonzero(np.isfinite(products) & query.any() & among)
    if len(rows) > number:
        least = np.partition(products[rows], -number)[-number]
        rows = rows[products[rows] >= least]
    best = rows[np.argsort(-products[rows], kind="stable")][:number]
    return best, products[best]


def match_and_score(
    query: Features, candidates: Sequence[Features], matcher: Matcher, scorers: Mapping[str, Scorer], typical: int
) -> tuple[list[Matches], dict[str, Float[np.ndarray, " candidates"]]]:
    """Matches `[1, K, ...]` of an unpadded query with each candidate, and scores by name.

    Images are padded to one of a few sizes by their own numbers of keypoints, so that no pair's result and time depend
    on the other pairs. Each core takes a few pairs at a time, since the steps after a pair's product keep one core
    busy. `typical` is a usual number of keypoints, or the detector's limit. An InputError if no score is finite.
    """
    padded_query = stack_features([query], padded_size(len(query.mask), typical), total=1)
    by_size = defaultdict[int, list[int]](list)
    for place, candidate in enumerate(candidates):
        by_size[padded_size(len(candidate.mask), typical)].append(place)
    parts = [
        (size, places[start : start + _PAIRS_AT_ONCE])
        for size, places in sorted(by_size.items(), reverse=True)
        for start in range(0, len(places), _PAIRS_AT_ONCE)
    ]

    def match_part(part: tuple[int, list[int]]) -> tuple[Matches, dict[str, np.ndarray]]:
        size, places = part
        images = stack_features([candidates[place] for place in places], size, total=_PAIRS_AT_ONCE)
        pairs = np.stack([np.zeros(_PAIRS_AT_ONCE, np.int32), np.arange(_PAIRS_AT_ONCE, dtype=np.int32)], axis=1)
        matches = match_pairs(padded_query, images, pairs, np.int32(len(places)), matcher)
        scores = {name: score_candidates(scorer, matches) for name, scorer in scorers.items()}
        for name, values in scores.items():
            require_scores(type(scorers[name]).__name__, values, _PAIRS_AT_ONCE)
        return jax.device_get((matches, {name: values.astype(np.float32) for name, values in scores.items()}))

    workers = min(available_cpus(), len(parts))
    map_parts = partial(ordered_map, workers=workers) if workers > 1 and knows_own_context() else map
    matches, scores = {}, {name: np.zeros(len(candidates), np.float32) for name in scorers}
    for (_, places), (of_part, scores_of_part) in zip(parts, map_parts(match_part, parts), strict=True):
        for number, place in enumerate(places):
            matches[place] = jax.tree.map(lambda leaf: leaf[number : number + 1], of_part)  # noqa: B023
        for name, values in scores_of_part.items():
            scores[name][places] = values[: len(places)]
    for name, values in scores.items():
        require_finite(name, values)
    return [matches[place] for place in range(len(candidates))], scores


def padded_size(count: int, typical: int) -> int:
    """Slots for an image: `typical` rounded up, or a power of 2 from 256 on: few sizes, so few programs."""
    size, typical = 1 << (max(count, _LEAST_SLOTS) - 1).bit_length(), round_up(typical, STEP)
    return min(size, typical) if typical >= count else size


def shift_of(
    scorers: Iterable[Scorer], pair: Matches, size: tuple[int, int]
) -> tuple[Point | None, tuple[Point, Point] | None]:
    """`shift` and `shift_interval` of a `Prediction` by the first histogram of shifts, from one pair.

    Shifts of the resized images become px of the query image, whose size is (width, height).
    """
    scorer = next((scorer for scorer in scorers if isinstance(scorer, HistogramOfShifts)), None)
    if scorer is None:
        return None, None
    histogram = fit_capacities(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval = (np.asarray(values)[0] for values in pair_shifts(histogram, pair))
    stretch = np.divide(size, np.asarray(pair.image_size0)[0])
    shift, interval = stretch * shift, stretch * interval
    point, low, high = ((float(x), float(y)) if np.isfinite(x + y) else None for x, y in (shift, *interval))
    return point, (low, high) if low and high else None
