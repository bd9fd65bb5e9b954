"""Functions of arrays that are exported: keypoints of an image, and scores of matches or of features."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from mfvpr.core.batch import BIN_STEP
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.scorer import Scorer, fit_capacities, on_host, require_scores
from mfvpr.core.types import Array, Features, Matches
from mfvpr.evaluation.system import System
from mfvpr.features.network import XFeatFeatures
from mfvpr.matchers.host_matcher import PairSource
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT, POSITIVE, list_of

Form = Literal["vectorized", "loop"]

# Axes, types and units of the fields of `Matches` and `Features`, without 0 and 1 and the candidates' axis C.
_AXES = {"points": "K2", "keypoints": "K2", "descriptors": "KD", "image_size": "2", "count": ""}  # others: "K"
_TYPES = {"mask": "bool", "index": "int32", "count": "int32", "image": "uint8"}  # others: "float32"
_PIXELS = ("points", "keypoints", "image_size", "shift")
_OF_QUERY = ("image_size0", "count0")  # fields of matches that all candidates share


@dataclass(frozen=True)
class ExportShapes:
    """Sizes of the arrays of an exported program, which are fixed; an `InputError` unless they are above 0.

        shapes = mfvpr.ExportShapes(candidates=50, keypoints=800, image_size=(640, 480))

    A scorer alone has no descriptors.
    """

    candidates: int  # C, of one query; fill up with candidates whose mask is False
    keypoints: int  # K, of each image; of a scorer alone: match slots of each pair
    image_size: tuple[float, float]  # largest (width, height), px; the capacities of histograms follow from it;
    # of an extractor: its own
    dimension: int | None = None  # D, of a descriptor; None = the extractor's

    def __post_init__(self) -> None:
        rules = {"candidates": COUNT, "keypoints": COUNT, "image_size": list_of(POSITIVE, 2), "dimension": COUNT | None}
        for name, rule in rules.items():
            rule.check(name, getattr(self, name))


class Tensor(NamedTuple):
    """An input or output of a program."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str
    axes: str

    @classmethod
    def of(cls, name: str, axes: str, shapes: ExportShapes) -> "Tensor":
        """The tensor of a name with these axes."""
        lengths = {"C": shapes.candidates, "K": shapes.keypoints, "D": shapes.dimension or 0, "2": 2, "3": 3}
        lengths |= dict(zip("WH", map(int, shapes.image_size), strict=True))
        field = name.rstrip("01")
        shape = tuple(lengths[axis] for axis in axes)
        return cls(name, shape, _TYPES.get(field, "float32"), "px" if field in _PIXELS else "", axes)


@dataclass(frozen=True)
class Program:
    """A function of arrays in the order of `inputs` that returns arrays in the order of `outputs`.

    `form` is how it goes over the candidates: "vectorized", or a "loop", which converters to other formats understand.
    An extractor then has direct convolutions.
    """

    shapes: ExportShapes
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    function: Callable[[dict[str, Array], Form], tuple[Array, ...]]
    parameters: Mapping[str, Any]  # scorers by output and the matcher, or the extractor
    left_out: tuple[str, ...] = ()  # rankings of the system that the program does not score

    def call(self, *arrays: Array, form: Form = "vectorized") -> tuple[Array, ...]:
        """The outputs for arrays in the order of `inputs`."""
        return self.function(dict(zip((each.name for each in self.inputs), arrays, strict=True)), form)


def make_program(
    method: Scorer | System | XFeatFeatures, shapes: ExportShapes, *, with_shift: bool, with_confidence: bool = False
) -> Program:
    """The program of an extractor, a scorer, or all scorers of a system, with the capacities for images of this size.

    The scores of the scorer that decides come first. An `InputError` says why a method cannot be exported.
    """
    if isinstance(method, XFeatFeatures):
        if with_shift or with_confidence:
            raise InputError("with_shift, with_confidence: expected a scorer or a system, got an extractor")
        return _make_extraction(method, shapes)
    matcher: Any = None
    scorers, left_out = {"scores": method}, ()
    names = [each.name for each in fields(Matches) if with_confidence or each.name != "confidence"]
    table = {name: "C" * (name not in _OF_QUERY) + _AXES.get(name.rstrip("01"), "K") for name in names}
    of_features = [each.name for each in fields(Features)]
    if isinstance(method, System):
        matcher, main, sides = method.pipeline.matcher, method.headline, {"0": "", "1": "C"}.items()
        table = {f"{name}{side}": first + _AXES.get(name, "K") for side, first in sides for name in of_features}
        shapes = replace(shapes, dimension=_dimension(method, shapes))
        if with_confidence:
            raise InputError("with_confidence=True: expected a scorer, got a system, whose matcher gives confidences")
        if main not in method.scorers:
            got = "a ranking that needs the retrieval or further queries; choose another with dataclasses.replace"
            raise InputError(f"final={main!r}: expected a scorer, got {got}")
        scorers = {"scores": method.scorers[main]}
        scorers |= {f"scores_{name}": scorer for name, scorer in method.scorers.items() if name != main}
        left_out = tuple(name for name in method.final_scores if name not in method.scorers)
    for name, scorer in scorers.items():
        if on_host(scorer):
            kind, expected = type(scorer).__name__, "a scorer that JAX compiles, not on the host (score_pairs)"
            raise InputError(f"{kind}: expected {expected}; leave it out")
        if not name.isidentifier():  # the name of a file
            got = name.removeprefix("scores_")
            raise InputError(f"scorers: expected names of letters, digits and _, got {got!r}; rename the scorer")
    if with_shift and not isinstance(scorers["scores"], HistogramOfShifts):
        got = type(scorers["scores"]).__name__
        raise InputError(f"with_shift=True: expected a HistogramOfShifts that decides, got {got}; leave with_shift out")
    size = np.asarray(shapes.image_size, np.float32)
    scorers = fit_capacities(scorers, size, size, multiple=BIN_STEP)

    def score(matches: Matches) -> tuple[Array, ...]:
        scores = [jnp.asarray(scorer(matches)) for scorer in scorers.values()]
        for scorer, values in zip(scorers.values(), scores, strict=True):
            require_scores(type(scorer).__name__, values[None], 1)
        main: Any = scorers["scores"]
        shift = [main.dominant_shift(matches, refine=True)] if with_shift else []
        return tuple(values.astype(jnp.float32) for values in (*scores, *shift))

    def score_matches(arrays: dict[str, Array], form: Form) -> tuple[Array, ...]:
        of_query = {name: arrays[name] for name in _OF_QUERY}
        copies = {name: jnp.broadcast_to(each, (shapes.candidates, *each.shape)) for name, each in of_query.items()}
        matches = Matches(**(arrays | copies))
        return _loop(score, matches) if form == "loop" else jax.vmap(score)(matches)

    def score_features(arrays: dict[str, Array], form: Form) -> tuple[Array, ...]:
        query, candidates = (Features(**{name: arrays[f"{name}{side}"] for name in of_features}) for side in "01")
        match: Callable[[Features], Matches] = partial(matcher, query)
        if form == "loop":
            return _loop(lambda candidate: score(match(candidate)), candidates)
        return jax.vmap(score)(jax.lax.map(match, candidates))  # one similarity matrix at a time

    inputs = tuple(Tensor.of(name, axes, shapes) for name, axes in table.items())
    outputs = tuple(Tensor.of(name, "C", shapes) for name in scorers)
    outputs += (Tensor.of("shift", "C2", shapes),) if with_shift else ()
    parts = scorers if matcher is None else {**scorers, "matcher": matcher}
    return Program(shapes, inputs, outputs, score_features if matcher else score_matches, parts, left_out)


def _make_extraction(extractor: XFeatFeatures, shapes: ExportShapes) -> Program:
    """The program that returns the strongest keypoints of an image by falling score; padding is 0."""
    size, most = extractor.image_size, extractor.slots(shapes.keypoints)
    if tuple(shapes.image_size) != tuple(size):
        raise InputError(f"image_size={[*shapes.image_size]}: expected that of the extractor, {[*size]}")
    if shapes.keypoints > most:
        raise InputError(f"keypoints={shapes.keypoints}: expected at most {most}, the extractor's max_keypoints")
    shapes = replace(shapes, dimension=extractor.model.dimension)

    def extract(arrays: dict[str, Array], form: Form) -> tuple[Array, ...]:
        model = nnx.clone(extractor.model)
        model.set_attributes(is_direct=form == "loop")
        (batch,) = extractor.compute(model, arrays["image"][None], slots=shapes.keypoints)
        result = jax.tree.map(lambda leaf: leaf[0], batch)
        vectors = (jnp.where(result.mask[:, None], each, 0) for each in (result.keypoints, result.descriptors))
        return (*vectors, result.scores, result.mask)

    table = {name: _AXES.get(name, "K") for name in ("keypoints", "descriptors", "scores", "mask")}
    outputs = tuple(Tensor.of(name, axes, shapes) for name, axes in table.items())
    return Program(shapes, (Tensor.of("image", "HW3", shapes),), outputs, extract, {"extractor": extractor})


def _dimension(system: System, shapes: ExportShapes) -> int:
    """Length of the descriptors; an InputError for features and matchers that a program cannot take."""
    extractor, matcher = system.pipeline.extractor, system.pipeline.matcher
    if len(extractor.scales) != 1 or isinstance(matcher, PairSource):
        expected = "local features of one scale and a matcher that JAX compiles"
        got = f"{len(extractor.scales)} scales of {type(extractor).__name__} and {type(matcher).__name__}"
        raise InputError(f"system: expected {expected}, got {got}; export a scorer alone")
    known = extractor.scales[0].dimension or shapes.dimension  # 0 = the extractor does not say
    if not known or shapes.dimension not in (None, known):
        raise InputError(f"dimension={shapes.dimension}: expected {known or 'the length of the descriptors'}")
    return known


def _loop(function: Callable[[Any], tuple[Array, ...]], pairs: Any) -> tuple[Array, ...]:
    """`function` of every entry of the first axis."""
    count = len(jax.tree.leaves(pairs)[0])

    def entry(index: Any) -> Any:
        return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, index, keepdims=False), pairs)

    def step(index: Any, outputs: tuple[Array, ...]) -> tuple[Array, ...]:
        parts = zip(outputs, function(entry(index)), strict=True)
        return tuple(jax.lax.dynamic_update_index_in_dim(output, each, index, 0) for output, each in parts)

    shapes = jax.eval_shape(lambda: function(entry(0)))
    return jax.lax.fori_loop(0, count, step, tuple(jnp.zeros((count, *each.shape), each.dtype) for each in shapes))
