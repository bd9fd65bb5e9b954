"""Data of all stages: Features -> Shortlist and Matches -> Ranking.

Axis letters: Q queries, C candidates, N keypoints, K match slots, D descriptor dimension. `0` = query, `1` = candidate.
Points are (x, y) in pixels of the image that the detector saw. `mask` is True on real entries; what padding holds
never matters, NaN included. Every field may carry leading batch axes. Arrays may be NumPy's or JAX's. Features and
Matches also take lists, arrays of torch and other libraries (DLPack) on any device, and masks of integers.

Arrays of fewer axes are never broadcast silently in this package: `values[None]` says so (the tests raise otherwise).
"""

from dataclasses import dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array

if TYPE_CHECKING:
    Array = Size = CandidateSize = Any  # pyright takes neither kind of array for the other
else:
    Array = jax.Array | np.ndarray | np.generic  # the host prepares arrays with NumPy, devices compute with JAX
    Size, CandidateSize = (Num[Array, f"*{axes} 2"] | None for axes in ("batch", "pairs"))
Class = TypeVar("Class", bound=type)


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def value(cls: Class) -> Class:
    """Make the class `cls` a frozen dataclass and a pytree, with fields that JAX may transform.

        @value
        class Threshold:
            largest: float = 0.8
            kind: str = field(default="l2", metadata={"static": True})

    Fields are leaves or subtrees. Fields with the metadata `static` (words, flags, capacities) select the compiled
    program: they are compared, and must be hashable. An integer in a field with a `float` default becomes a float.
    Unflattening calls no `__init__`.

    A compiled program keeps the code of its methods and the values of globals: define the class again to change them.

    `jax.tree_util.register_dataclass` registers a class in the same way, but jaxlib up to 0.10 compares its nodes
    without their class: with such classes, a `jit` of your own may run the program of another class.
    """
    data: Any = cls if is_dataclass(cls) and "__dataclass_fields__" in vars(cls) else dataclass(frozen=True)(cls)
    static = [f.name for f in fields(data) if f.metadata.get("static")]
    dynamic = [f.name for f in fields(data) if not f.metadata.get("static")]
    floats = {f.name for f in fields(data) if isinstance(f.default, float)}
    keys = [jax.tree_util.GetAttrKey(name) for name in dynamic]

    def child(self: Any, name: str) -> Any:
        content = getattr(self, name)
        return float(content) if type(content) is int and name in floats else content

    def flatten(self: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [child(self, name) for name in dynamic], tuple(getattr(self, name) for name in static)

    def flatten_with_keys(self: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children, statics = flatten(self)
        return list(zip(keys, children, strict=True)), statics

    def unflatten(statics: tuple[Any, ...], children: Any) -> Any:
        self = object.__new__(data)
        for name, content in (*zip(static, statics, strict=True), *zip(dynamic, children, strict=True)):
            object.__setattr__(self, name, content)
        return self

    jax.tree_util.register_pytree_with_keys(data, flatten_with_keys, unflatten, flatten)
    return data


def short_repr(self: Any) -> str:
    """`__repr__` of a dataclass with types and shapes in place of arrays, without None."""
    contents = {f.name: getattr(self, f.name) for f in fields(self)}
    texts = {n: f"{c.dtype}{list(c.shape)}" if hasattr(c, "dtype") else repr(c) for n, c in contents.items()}
    return f"{type(self).__name__}({', '.join(f'{n}={text}' for n, text in texts.items() if text != 'None')})"


def _check_arrays(self: Any) -> None:
    """Convert arrays of other libraries and masks of integers; an InputError if shapes do not fit the mask."""
    arrays = {f.name: as_array(getattr(self, f.name)) for f in fields(self)}
    if not hasattr(mask := arrays["mask"], "dtype"):  # no data, but for instance `in_axes` of `vmap`
        return
    if mask.dtype.kind not in "biu":
        raise InputError(f"{type(self).__name__}.mask: expected True and False, got {mask.dtype}")
    for name, values in (arrays | {"mask": mask if mask.dtype == bool else mask != 0}).items():
        object.__setattr__(self, name, values)
        if values is None or name.startswith("count"):
            continue
        last = np.shape(values)[-1:] if name == "descriptors" else (2,) if "points" in name else ()
        expected = (*mask.shape, *last)
        if name.startswith("image_size"):
            expected = (*(mask.shape[:-1] if name == "image_size" else np.shape(values)[:-1]), 2)
        if np.shape(values) != expected:
            raise InputError(
                f"{type(self).__name__}.{name}: expected shape {list(expected)} beside a mask {list(mask.shape)}, "
                f"got {list(np.shape(values))}"
            )


@value
class Features:
    """Local features of one image.

        features = Features.of(keypoints, descriptors, image_size=(640, 480))

    Attributes:
        keypoints: `[..., N, 2]` (x, y), px.
        descriptors: `[..., N, D]`; this library's networks and RootSIFT have unit length, others may differ.
        scores: `[..., N]` detection scores, larger = better.
        mask: `[..., N]`, False on padding.
        image_size: `[..., 2]` (width, height), px; None = unknown, which scorers that need it refuse.
    """

    keypoints: Num[Array, "*batch keypoints 2"]
    descriptors: Num[Array, "*batch keypoints dimensions"]
    scores: Num[Array, "*batch keypoints"]
    mask: Bool[Array, "*batch keypoints"]
    image_size: Size = field(metadata={"per_image": True})

    __post_init__, __repr__ = _check_arrays, short_repr

    @classmethod
    def of(
        cls, keypoints: Any, descriptors: Any, *, scores: Any = None, mask: Any = None, image_size: Any = None
    ) -> "Features":
        """Features of arrays or lists, NumPy's, JAX's, torch's or of any library with DLPack; shapes as above.

        The weight 2 - distance expects descriptors of unit length. Without `scores` all are 1, without a `mask` all are
        keypoints; without an image size, a scorer that needs it raises an `InputError`, as do different lengths.
        """
        shape = np.shape(keypoints := as_array(keypoints))[:-1]
        scores = np.ones(shape, np.float32) if scores is None else scores
        mask = np.ones(shape, bool) if mask is None else mask
        return cls(keypoints, *map(as_array, (descriptors, scores, mask, image_size)))


def per_keypoint(features: Features) -> dict[str, Array]:
    """Fields with a value for every keypoint, `[..., N, ...]` by name, with the mask."""
    return {f.name: getattr(features, f.name) for f in fields(features) if not f.metadata.get("per_image")}


@value
class Matches:
    """Putative matches between a query image (0) and a candidate (1).

        matches = mfvpr.match(features0, features1)  # points0[matches.mask], points1[matches.mask] are real

    Attributes:
        points0, points1: `[..., K, 2]` (x, y), px.
        distance: `[..., K]` Euclidean distance of the descriptors, in [0, 2] for unit length.
        scores0, scores1: `[..., K]` detection scores.
        mask: `[..., K]`, False on padding.
        image_size0, image_size1: `[..., 2]` (width, height), px; None = unknown.
        ratio: `[..., K]` distance to the nearest descriptor of the candidate over the distance to the second nearest,
            in [0, 1]; None unless the matcher was asked for it (`with_ratio=True`).
        confidence: `[..., K]` in [0, 1], how certain a match is; multiplies its weight. None = 1.
        index0, index1: `[..., K]` int32, number of the match's keypoint in its image; None = unknown.
        count0, count1: `[...]` int32, number of keypoints of the image, matched or not; None = unknown.

    In a `MatchSet`, the slots of one query hold the matches with all C candidates: `image_size1` is `[C, 2]` and
    `count1` `[C]` there.
    """

    points0: Num[Array, "*batch slots 2"]
    points1: Num[Array, "*batch slots 2"]
    distance: Num[Array, "*batch slots"]
    scores0: Num[Array, "*batch slots"]
    scores1: Num[Array, "*batch slots"]
    mask: Bool[Array, "*batch slots"]
    image_size0: Size = field(metadata={"per_pair": True})
    image_size1: CandidateSize = field(metadata={"per_pair": True})
    ratio: Num[Array, "*batch slots"] | None = None
    confidence: Num[Array, "*batch slots"] | None = None
    index0: Int[Array, "*batch slots"] | None = None
    index1: Int[Array, "*batch slots"] | None = None
    count0: Int[Array, "*batch"] | None = field(default=None, metadata={"per_pair": True})
    count1: Int[Array, "*pairs"] | None = field(default=None, metadata={"per_pair": True})

    __post_init__, __repr__ = _check_arrays, short_repr


INDICES = ("index0", "index1")  # integer fields, which take part in no arithmetic


def per_match(matches: Matches) -> dict[str, Array]:
    """Fields with a value for every match, `[..., K, ...]` by name, without mask and None."""
    values = {f.name: getattr(matches, f.name) for f in fields(matches) if not f.metadata.get("per_pair")}
    return {name: entries for name, entries in values.items() if name != "mask" and entries is not None}


def per_pair(matches: Matches) -> dict[str, Array]:
    """Fields with one value per pair of images, `[..., ...]` by name, without None."""
    values = {f.name: getattr(matches, f.name) for f in fields(matches) if f.metadata.get("per_pair")}
    return {name: entries for name, entries in values.items() if entries is not None}


@value
class Shortlist:
    """Best candidates of the retrieval for each query.

        shortlist = mfvpr.retrieve(query_descriptors, database_descriptors, num_candidates=50)

    Attributes:
        indices: database rows, int32, best first, -1 = none.
        scores: retrieval scores (cosine similarity).
        mask: False where the index is -1.
    """

    indices: Int[Array, "queries candidates"]
    scores: Float[Array, "queries candidates"]
    mask: Bool[Array, "queries candidates"]

    __repr__ = short_repr


@value
class Ranking:
    """A re-ranked shortlist.

        np.take_along_axis(shortlist.indices, mfvpr.rerank(scores, shortlist.mask).order, axis=1)  # [Q, C] rows

    `order` are positions into the shortlist, int32, best first; `scores` stay in the shortlist's order (not sorted).
    """

    order: Int[Array, "*queries candidates"]
    scores: Float[Array, "*queries candidates"]

    __repr__ = short_repr
