"""Matches from a program that runs on the host, such as a torch network, or from files."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import UInt8

from mfvpr.core.types import INDICES, Features, Matches, Shortlist, per_match
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import Interpolation, resize
from mfvpr.features.feature_set import FeatureSet
from mfvpr.io.containers import shorten
from mfvpr.io.matches import numbered_matches, point_matches
from mfvpr.matchers.match_set import Pair, QueryMatches, join_candidates
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT, check_fields, list_of, setting, word_of
from mfvpr.utils.numerics import as_array

Inputs = Literal["images", "features"]
Side = ImageFolder | FeatureSet  # the images, or the features of the images, of queries or of the database


class HostPairs(Protocol):
    """Matches of queries with database images."""

    numbered: bool  # whether matches have the numbers of keypoints (`index0`, `index1`, `count0`, `count1`)

    def read(self, query: int, candidates: Sequence[int]) -> Sequence[Matches | None]:
        """Matches `[n]` of a query with each candidate, NumPy, without padding, with confidences; None = no matches."""
        ...

    def warnings(self, shortlist: Shortlist) -> list[str]:
        """Warnings about the pairs of a shortlist, one line each, before they are matched."""
        ...


@runtime_checkable
class PairSource(Protocol):
    """Finds matches on the host, a query at a time."""

    @property
    def inputs(self) -> Inputs: ...

    def open(self, queries: Any, database: Any) -> HostPairs:
        """Pairs of the two sides, folders of images or sets of their features as `inputs` says."""
        ...


@dataclass(frozen=True)
class HostMatcher:
    """A matcher of your own that JAX cannot compile, such as a torch network.

        def match(first, second):  # images: uint8 RGB [H, W, 3]
            result = network(first, second)
            return result["points0"], result["points1"], result["confidence"]

        pipeline = mfvpr.Pipeline(extractor, retriever, HostMatcher(match, "network 1.0", image_size=(640, 480)))

    The function returns the matches of one pair, as arrays of any library with DLPack, on any device:

    - of two images: points `[M, 2]` of both, (x, y) px of these images, and optionally confidences `[M]` from 0 to 1;
      or a mapping with `matched_kpts0`, `matched_kpts1` and optionally `matched_confidences`, as vismatch returns it;
    - of two Features (NumPy, without padding): numbers of keypoints `[M]`, and optionally confidences `[M]`.

    Attributes:
        function: of the query and the candidate.
        name: of the program, its version and weights, by which a cache knows the matches, not by the function's code.
        inputs: what the function takes; with images, the extractor of a pipeline is used only for retrieval.
        image_size: (width, height) that images are resized to, px; None = their own size.
        interpolation: of the resizing.
        batch_size: None = the function takes one pair. A number = it takes two lists of up to that many, query and
            candidates, and returns a list of the matches of each pair.

    Raises:
        InputError: wrong settings; or, when pairs are matched, a result of another form, points outside the images, or
            confidences beyond 0 to 1.
    """

    function: Callable[[Any, Any], Any] = field(metadata={"recipe": False})
    name: str
    inputs: Inputs = setting("images", word_of(Inputs))
    image_size: tuple[int, int] | None = setting(None, list_of(COUNT, 2) | None)
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    batch_size: int | None = setting(None, COUNT | None, recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.name:
            raise InputError("name='': expected the name of the program and its weights, for the cache; set it")
        if self.image_size is not None and self.inputs == "features":
            raise InputError(f"image_size={self.image_size}: expected None with inputs='features'; leave it out")

    def open(self, queries: Side, database: Side) -> "_CalledPairs":
        return _CalledPairs(self, queries, database)


@dataclass(frozen=True)
class _CalledPairs:
    matcher: HostMatcher
    queries: Any
    database: Any

    @property
    def numbered(self) -> bool:
        return self.matcher.inputs == "features"

    def warnings(self, shortlist: Shortlist) -> list[str]:
        return []

    def read(self, query: int, candidates: Sequence[int]) -> list[Matches | None]:
        first, (function, size) = self._input(self.queries, query), (self.matcher.function, self.matcher.batch_size)
        matches: dict[int, Matches | None] = dict.fromkeys(candidates)
        if first is None:
            return [None for _ in candidates]
        copy = partial(jax.tree.map, np.array)  # the function may change its arguments
        for start in range(0, len(candidates), size or 1):
            inputs = {row: self._input(self.database, row) for row in candidates[start : start + (size or 1)]}
            inputs = {row: second for row, second in inputs.items() if second is not None}
            if size is None:
                results = [function(copy(first), copy(second)) for second in inputs.values()]
            else:
                results = function([copy(first) for _ in inputs], [*map(copy, inputs.values())]) if inputs else []
            if not isinstance(results, Sequence) or len(results) != len(inputs):
                got = len(results) if isinstance(results, Sequence) else type(results).__name__
                expected = f"a list of the matches of {len(inputs)} pairs"
                raise InputError(f"{self.matcher.name}: expected {expected}, got {got}")
            for (row, second), result in zip(inputs.items(), results, strict=True):
                matches[row] = self._convert(query, row, result, first, second)
        return [matches[row] for row in candidates]

    def _input(self, side: Any, row: int) -> UInt8[np.ndarray, "height width 3"] | Features | None:
        """The image or the features of a row; None = an image without features."""
        if self.numbered:
            return side[row] if side.counts[row] > 0 else None
        image, size = side.read(row), self.matcher.image_size
        return image if size is None else resize(image, size, self.matcher.interpolation)

    def _convert(self, query: int, row: int, result: Any, first: Any, second: Any) -> Matches:
        where = f"{self.matcher.name}: query {query} and database image {row}"
        if isinstance(result, Mapping):
            result = [result.get(name) for name in ("matched_kpts0", "matched_kpts1", "matched_confidences")]
        if not isinstance(result, tuple | list) or len(result) not in (2, 3) or result[0] is None or result[1] is None:
            expected = "two arrays and optionally confidences, or matched_kpts0 and matched_kpts1"
            raise InputError(f"{where}: expected {expected}, got {type(result).__name__}")
        try:
            values = [None if part is None else np.array(as_array(part)) for part in result]  # of a buffer, perhaps
        except Exception as error:  # of NumPy for ragged lists, of any library for tensors that are not dense
            reason = shorten(" ".join(str(error).split()), 160)
            raise InputError(f"{where}: expected dense arrays, got others ({reason})") from error
        confidence = values[2] if len(values) == 3 else None
        if self.numbered:
            return numbered_matches(where, values[0], values[1], confidence, first, second)
        sizes = [(each.shape[1], each.shape[0]) for each in (first, second)]
        return point_matches(where, values[0], values[1], confidence, *sizes)


def match_queries(
    queries: Side, database: Side, candidates: Shortlist, rows: Sequence[int], source: PairSource
) -> Iterator[tuple[int, QueryMatches]]:
    """Match queries with their candidates on the host: (row, matches) in the order of `rows`."""
    indices, scores = np.asarray(candidates.indices), np.asarray(candidates.scores)
    pairs, no_points = source.open(queries, database), np.zeros((0, 2), np.float32)
    no_matches = per_match(point_matches("", no_points, no_points, None, (1, 1), (1, 1)))
    no_matches |= dict.fromkeys(INDICES, np.zeros(0, np.int32)) if pairs.numbered else {}
    for query in rows:
        real = indices[query] >= 0
        matches = iter(pairs.read(query, indices[query][real].tolist()))
        of_query = [next(matches) if is_real else None for is_real in real]
        counts = [(0, 0) if each is None else (each.count0, each.count1) for each in of_query]
        count0, count1 = np.array(counts, np.int32).reshape(-1, 2).T if pairs.numbered else (None, None)
        joined = join_candidates(
            [None if each is None else Pair(per_match(each), each.image_size0, each.image_size1) for each in of_query],
            no_matches,
            None if count0 is None else count0.max(initial=0),
            count1,
        )
        yield query, QueryMatches(*joined, indices[query], scores[query])
