"""Functions of arrays that are exported: scores of matches, or of the features of a query and its candidates."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.core.batch import BIN_STEP
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.parameters import with_capacity
from mfvpr.core.scorer import Scorer, on_host, require_scores
from mfvpr.core.types import Array, Features, Matches
from mfvpr.evaluation.system import System
from mfvpr.matchers.host_matcher import PairSource
from mfvpr.matchers.matcher import Matcher
from mfvpr.utils.errors import InputError

Form = Literal["vectorized", "loop"]

FIELDS = {
    "points0": ("CK2", "float32", "px"),
    "points1": ("CK2", "float32", "px"),
    "distance": ("CK", "float32", ""),
    "scores0": ("CK", "float32", ""),
    "scores1": ("CK", "float32", ""),
    "mask": ("CK", "bool", ""),
    "image_size0": ("2", "float32", "px"),
    "image_size1": ("C2", "float32", "px"),
    "ratio": ("CK", "float32", ""),
    "confidence": ("CK", "float32", ""),
    "index0": ("CK", "int32", ""),
    "index1": ("CK", "int32", ""),
    "count0": ("", "int32", ""),
    "count1": ("C", "int32", ""),
}
"""Axes, type and unit of the inputs of a scorer: the fields of `Matches`, those of the query without the axis C."""

FEATURES = {
    "keypoints0": ("K2", "float32", "px"),
    "descriptors0": ("KD", "float32", ""),
    "scores0": ("K", "float32", ""),
    "mask0": ("K", "bool", ""),
    "image_size0": ("2", "float32", "px"),
    "keypoints1": ("CK2", "float32", "px"),
    "descriptors1": ("CKD", "float32", ""),
    "scores1": ("CK", "float32", ""),
    "mask1": ("CK", "bool", ""),
    "image_size1": ("C2", "float32", "px"),
}
"""Axes, type and unit of the inputs of a system: the fields of `Features` of the query (0) and the candidates (1)."""


@dataclass(frozen=True)
class ExportShapes:
    """Sizes of the arrays of an exported program, which are fixed; an `InputError` unless they are above 0.

        mfvpr.ExportShapes(candidates=50, keypoints=800, image_size=(640, 480))

    Attributes:
        candidates: C, of one query; fill up with candidates whose mask is False.
        keypoints: K, of each image; of a scorer alone: match slots of each pair.
        image_size: largest (width, height) of an image, px; the capacities of histograms follow from it.
        dimension: D, of a descriptor; None = the extractor's. A scorer alone has no descriptors.
    """

    candidates: int
    keypoints: int
    image_size: tuple[float, float]
    dimension: int | None = None

    def __post_init__(self) -> None:
        names = ("candidates", "keypoints") if self.dimension is None else ("candidates", "keypoints", "dimension")
        for name in names:
            if not isinstance(number := getattr(self, name), int) or number < 1:
                raise InputError(f"{name}={number!r}: expected a whole number from 1")
        size = np.asarray(self.image_size, np.float64)
        if size.shape != (2,) or not (np.isfinite(size) & (size > 0)).all():
            raise InputError(f"image_size={self.image_size!r}: expected (width, height) above 0, px")
        object.__setattr__(self, "image_size", tuple(size.tolist()))


class Tensor(NamedTuple):
    """An input or output of a program."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str
    axes: str


@dataclass(frozen=True)
class Program:
    """A function of arrays in the order of `inputs` that returns arrays in the order of `outputs`.

    `form` is how it goes over the candidates: "vectorized", as this library does, or a "loop", which converters to
    other formats understand.
    """

    shapes: ExportShapes
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    function: Callable[[dict[str, Array], Form], tuple[Array, ...]]
    parameters: Mapping[str, Any]  # scorers by output, and the matcher
    left_out: tuple[str, ...] = ()  # rankings of the system that the program does not score

    def call(self, *arrays: Array, form: Form = "vectorized") -> tuple[Array, ...]:
        """The outputs for arrays in the order of `inputs`."""
        return self.function(dict(zip((each.name for each in self.inputs), arrays, strict=True)), form)


def make_program(
    method: Scorer | System, shapes: ExportShapes, *, with_shift: bool, with_confidence: bool = False
) -> Program:
    """The program of a scorer or of a system."""
    if isinstance(method, System):
        if with_confidence:
            raise InputError("with_confidence=True: expected a scorer, got a system, whose matcher gives confidences")
        return _system_program(method, shapes, with_shift=with_shift)
    return _scorer_program(method, shapes, with_shift=with_shift, with_confidence=with_confidence)


def _scorer_program(scorer: Scorer, shapes: ExportShapes, *, with_shift: bool, with_confidence: bool) -> Program:
    """Matches of C candidates -> their scores."""
    scorers = _scorers({"scores": scorer}, shapes)

    def function(arrays: dict[str, Array], form: Form) -> tuple[Array, ...]:
        of_query = {name: arrays[name] for name in ("image_size0", "count0")}
        copies = {
            name: jnp.broadcast_to(values, (shapes.candidates, *values.shape)) for name, values in of_query.items()
        }
        return _over(_score_pair(scorers, with_shift), Matches(**(arrays | copies)), form)

    inputs = {name: field for name, field in FIELDS.items() if with_confidence or name != "confidence"}
    return Program(shapes, _tensors(inputs, shapes), _outputs(scorers, shapes, with_shift), function, scorers)


def _system_program(system: System, shapes: ExportShapes, *, with_shift: bool) -> Program:
    """Features of a query and C candidates -> scores of all scorers; the deciding score comes first."""
    scales, main = system.pipeline.extractor.scales, system.headline
    if len(scales) != 1:
        name = type(system.pipeline.extractor).__name__
        raise InputError(f"{name}: expected local features of one scale, got {len(scales)}; export a scorer alone")
    if isinstance(system.pipeline.matcher, PairSource):
        name = type(system.pipeline.matcher).__name__
        raise InputError(f"{name}: expected a matcher that JAX compiles, not on the host; export a scorer alone")
    if main not in system.scorers:
        raise InputError(
            f"final={main!r}: expected a scorer, got a ranking that needs the retrieval or further queries; choose "
            "another by dataclasses.replace(system, final=...)"
        )
    names = [main, *(name for name in system.scorers if name != main)]
    outputs = {"scores" if name == main else f"scores_{name}": system.scorers[name] for name in names}
    scorers, matcher = _scorers(outputs, shapes), system.pipeline.matcher
    shapes = _with_dimension(shapes, scales[0].dimension)

    def function(arrays: dict[str, Array], form: Form) -> tuple[Array, ...]:
        query, candidates = (_features(arrays, side) for side in "01")
        return _match_and_score(query, candidates, matcher, _score_pair(scorers, with_shift), form)

    left_out = tuple(name for name in system.final_scores if name not in system.scorers)
    tensors, parts = _tensors(FEATURES, shapes), {**scorers, "matcher": matcher}
    return Program(shapes, tensors, _outputs(scorers, shapes, with_shift), function, parts, left_out)


def _scorers(scorers: Mapping[str, Scorer], shapes: ExportShapes) -> dict[str, Scorer]:
    """Scorers with the capacities that images need; an InputError for scorers that JAX cannot compile."""
    for output, scorer in scorers.items():
        if on_host(scorer):
            name = type(scorer).__name__
            raise InputError(
                f"{name}: expected a scorer that JAX compiles, not on the host (score_pairs); leave it out"
            )
        if not output.isidentifier():
            name = output.removeprefix("scores_")
            raise InputError(f"scorers: expected names of letters, digits and _, got {name!r}; rename the scorer")
    size = np.asarray(shapes.image_size, np.float32)
    return with_capacity(dict(scorers), size, size, multiple=BIN_STEP)


def _with_dimension(shapes: ExportShapes, dimension: int) -> ExportShapes:
    """Shapes with the length of the extractor's descriptors, 0 = not known."""
    if shapes.dimension is None and not dimension:
        raise InputError("dimension=None: expected the length of the descriptors, which this extractor does not say")
    if shapes.dimension not in (None, dimension) and dimension:
        raise InputError(
            f"dimension={shapes.dimension}: expected {dimension}, the length of the extractor's descriptors"
        )
    return replace(shapes, dimension=shapes.dimension or dimension)


def _tensors(table: Mapping[str, tuple[str, str, str]], shapes: ExportShapes) -> tuple[Tensor, ...]:
    lengths = {"C": shapes.candidates, "K": shapes.keypoints, "D": shapes.dimension or 0, "2": 2}
    return tuple(
        Tensor(name, tuple(lengths[axis] for axis in axes), dtype, unit, axes)
        for name, (axes, dtype, unit) in table.items()
    )


def _outputs(scorers: Mapping[str, Scorer], shapes: ExportShapes, with_shift: bool) -> tuple[Tensor, ...]:
    if with_shift and not isinstance(scorers["scores"], HistogramOfShifts):
        got = type(scorers["scores"]).__name__
        raise InputError(f"with_shift=True: expected a HistogramOfShifts that decides, got {got}; leave with_shift out")
    table = {name: ("C", "float32", "") for name in scorers}
    return _tensors(table | ({"shift": ("C2", "float32", "px")} if with_shift else {}), shapes)


def _score_pair(scorers: Mapping[str, Scorer], with_shift: bool) -> Callable[[Matches], tuple[Array, ...]]:
    """Function of one pair: its scores, and its dominant shift."""

    def score(matches: Matches) -> tuple[Array, ...]:
        scores = [jnp.asarray(scorer(matches)) for scorer in scorers.values()]
        for scorer, values in zip(scorers.values(), scores, strict=True):
            require_scores(type(scorer).__name__, values[None], 1)
        main: Any = scorers["scores"]
        shift = [main.dominant_shift(matches, refine=True)] if with_shift else []
        return tuple(values.astype(jnp.float32) for values in (*scores, *shift))

    return score


def _features(arrays: Mapping[str, Array], side: str) -> Features:
    names = ("keypoints", "descriptors", "scores", "mask", "image_size")
    return Features(**{name: arrays[f"{name}{side}"] for name in names})


def _match_and_score(
    query: Features, candidates: Features, matcher: Matcher, score: Callable[[Matches], tuple[Array, ...]], form: Form
) -> tuple[Array, ...]:
    def match(candidate: Features) -> Matches:
        return matcher(query, candidate)

    if form == "loop":
        return _over(lambda candidate: score(match(candidate)), candidates, form)
    return jax.vmap(score)(jax.lax.map(match, candidates))  # one similarity matrix at a time, as in match_candidates


def _over(function: Callable[[Any], tuple[Array, ...]], pairs: Any, form: Form) -> tuple[Array, ...]:
    """`function` of every entry of the first axis."""
    if form == "vectorized":
        return jax.vmap(function)(pairs)
    count = len(jax.tree.leaves(pairs)[0])

    def entry(index: Any) -> Any:
        return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, index, keepdims=False), pairs)

    def step(index: Any, outputs: tuple[Array, ...]) -> tuple[Array, ...]:
        values = function(entry(index))
        update = jax.lax.dynamic_update_index_in_dim
        return tuple(update(output, each, index, 0) for output, each in zip(outputs, values, strict=True))

    shapes = jax.eval_shape(lambda: function(entry(0)))
    return jax.lax.fori_loop(0, count, step, tuple(jnp.zeros((count, *each.shape), each.dtype) for each in shapes))
