"""Contract of scorers as a test for your own scorer: call `check_scorer(MyScorer())` in a test.

The library relies on this contract when it pads, batches, sweeps and learns; see `mfvpr.Scorer`.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.core.batch import score_candidates
from mfvpr.core.scorer import Scorer, fit_capacities, on_host
from mfvpr.core.types import Array, Matches, per_match
from mfvpr.utils.errors import NoGradientError
from mfvpr.utils.numerics import holds_function

SLOTS = 48
COUNTS = (0, 1, 2, 17, 40)
TOLERANCE = 1e-4  # of the largest score: float32 sums in another order


def check_scorer(
    scorer: Scorer, *, image_size: tuple[int, int] = (336, 336), num_keypoints: int | None = None, seed: int = 0
) -> None:
    """Check that a scorer fulfills the contract, on synthetic matches.

    Checks, in this order: the scorer is a value or a plain function; scores are scalars, float32 and finite, and
    exactly 0 without matches; padding and the order of the matches change nothing; a batch has the scores of its pairs;
    `jit` does not change scores, and traces once for all numbers; gradients are finite, or raise a `NoGradientError`.

    Args:
        scorer: any scorer; if it samples, it must be reproducible, and may hold a key.
        image_size: (width, height) of the images, px.
        num_keypoints: of each image, at least 40; None = three times the number of matches.
        seed: of the matches.

    Raises:
        AssertionError: the scorer violates the contract; the message says how, and the usual fix.
    """
    try:
        _check(scorer, image_size, num_keypoints, seed)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise AssertionError(
            f"{type(scorer).__name__} asks Python for a number that jit has not computed yet (if, while, float(), "
            "np.asarray): use jnp.where and jax.numpy, or make what it asks for a static field"
        ) from error


def _check(scorer: Scorer, image_size: tuple[int, int], num_keypoints: int | None, seed: int) -> None:
    _check_is_value(scorer)
    pairs = [_random_matches(seed, count, image_size, num_keypoints or 3 * count) for count in COUNTS]
    scorer = fit_capacities(scorer, pairs[0].image_size0, pairs[0].image_size1)
    scores = np.array([_check_scalar(scorer, pair, count) for pair, count in zip(pairs, COUNTS, strict=True)])
    close = partial(_assert_close, TOLERANCE * float(np.abs(scores).max()))
    score_of = scorer if on_host(scorer) else jax.jit(lambda pair: scorer(pair))
    for pair, score in zip(pairs, scores, strict=True):
        close(score_of(pair), score, "jit scores otherwise than without; use jax.numpy on matches")
        for garbage in (np.inf, -1e30, 7.0):
            fix = "take values by mfvpr.masked(values, matches.mask)"
            close(score_of(_pad(pair, garbage, SLOTS)), score, f"padding that holds {garbage} changes the score; {fix}")
        fix = "count with matches.mask, not with the number of slots"
        close(score_of(_pad(pair, np.nan, SLOTS + 16)), score, f"more slots of padding change the score; {fix}")
        order = np.random.default_rng(1).permutation(SLOTS)
        shuffled = replace(pair, mask=pair.mask[order], **{n: values[order] for n, values in per_match(pair).items()})
        broken = "the order of the matches, and where padding stands among them, changes the score"
        close(score_of(shuffled), score, broken)
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *pairs)
    close(score_candidates(scorer, batch), scores, "vmap over a batch of pairs does not score as the pairs one by one")
    if on_host(scorer):
        return
    if not holds_function(scorer):  # a scorer that holds a function is compiled at every call
        _check_one_trace(scorer, pairs[-1], close)
    gradients = jax.jit(_gradients(scorer))
    with suppress(NoGradientError):
        for pair in pairs:
            of_numbers, of_entries = gradients(pair)
            named = [(f"a number of {type(scorer).__name__}", gradient) for gradient in of_numbers]
            for entry, gradient in (*named, *of_entries.items()):
                if not np.isfinite(gradient).all():
                    raise AssertionError(
                        f"the gradient for {entry} is not finite with {pair.mask.sum()} matches: mask values before "
                        "any arithmetic, not its result, and use mfvpr.safe_sqrt for lengths"
                    )


def _check_is_value(scorer: Any) -> None:
    name = type(scorer).__name__
    if jax.tree_util.all_leaves([scorer]) and not hasattr(scorer, "__code__"):
        raise AssertionError(
            f"{name} is no pytree, so that its numbers cannot be batched, and every call compiles: decorate the class "
            "with @mfvpr.value, or pass a plain function"
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(scorer):
        if not (callable(leaf) or isinstance(leaf, int | float | complex | np.ndarray | np.generic | jax.Array)):
            raise AssertionError(
                f"{name}{jax.tree_util.keystr(path)} = {leaf!r} is no number: jit cannot trace it; mark the field as "
                "static, with field(metadata={'static': True})"
            )


def _check_scalar(scorer: Scorer, pair: Matches, count: int) -> np.ndarray:
    score = jnp.asarray(scorer(pair))
    if score.shape != () or score.dtype != jnp.float32:
        got = f"shape {score.shape} of {score.dtype}"
        raise AssertionError(f"expected a scalar of float32, got {got} for {count} matches")
    if not np.isfinite(score):
        raise AssertionError(
            f"the score of {count} matches is {score}: padding holds NaN, so take values by mfvpr.masked(values, "
            "matches.mask) before any arithmetic"
        )
    if count == 0 and score != 0:
        raise AssertionError(f"a pair without matches scores {score}, expected exactly 0; mask every term")
    return np.asarray(score)


def _check_one_trace(scorer: Scorer, pair: Matches, close: Callable[..., None]) -> None:
    traces = []

    @jax.jit
    def score(scorer: Any, pair: Matches) -> Array:
        traces.append(1)
        return scorer(pair)

    for factor in (1.0, 1.01, 1.02):
        changed = jax.tree.map(lambda leaf: leaf * factor if _is_floating(leaf) else leaf, scorer)  # noqa: B023
        expected = changed(pair)
        close(score(changed, pair), expected, "jit scores other numbers otherwise than without; use jax.numpy on them")
    if len(traces) > 1:
        raise AssertionError(
            f"{len(traces)} traces for three sets of numbers, expected one: keep numbers as they are "
            "given, and what changes shapes in static fields"
        )


def _gradients(scorer: Any) -> Callable[[Matches], tuple[list[Array], dict[str, Array]]]:
    """Gradients of one pair's score with respect to the scorer's numbers and to the matches."""
    leaves, structure = jax.tree.flatten(scorer)
    positions = [position for position, leaf in enumerate(leaves) if _is_floating(leaf)]

    def gradients(pair: Matches) -> tuple[list[Array], dict[str, Array]]:
        def score(numbers: list[Array], entries: dict[str, Array]) -> Array:
            changed = dict(enumerate(leaves)) | dict(zip(positions, numbers, strict=True))
            return jax.tree.unflatten(structure, changed.values())(replace(pair, **entries))

        numbers = [jnp.asarray(leaves[position], jnp.float32) for position in positions]
        entries = {name: values for name, values in per_match(pair).items() if _is_floating(values)}
        return jax.grad(score, argnums=(0, 1))(numbers, entries)

    return gradients


def _assert_close(tolerance: float, got: Any, expected: Any, broken: str) -> None:
    got, expected = np.asarray(got), np.asarray(expected)
    if got.shape != expected.shape or not (np.abs(got - expected) <= tolerance).all():
        raise AssertionError(f"{broken}: got {got}, expected {expected}")


def _is_floating(leaf: Any) -> bool:
    return not callable(leaf) and jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def _random_matches(seed: int, count: int, image_size: tuple[int, int], num_keypoints: int) -> Matches:
    """Matches of one pair, half of them with the same shift; padding holds NaN."""
    rng, size = np.random.default_rng([seed, count]), np.array(image_size, np.float32)
    points0, anywhere = (rng.uniform(0, size, (count, 2)) for _ in range(2))
    points1 = np.where(rng.random((count, 1)) < 0.5, np.clip(points0 + size / 9, 0, size - 1), anywhere)
    points1[-1:] = points0[-1:]  # the length of a shift of 0 has no gradient
    unit = (rng.uniform(0.05, 0.95, count) for _ in range(5))
    entries = [np.asarray(values, np.float32) for values in (points0, points1, *unit)]
    points0, points1, distance, scores0, scores1, ratio, confidence = entries
    indices = (rng.permutation(num_keypoints)[:count].astype(np.int32) for _ in range(2))
    counts, real = np.full(2, num_keypoints, np.int32), np.ones(count, bool)
    pair = Matches(points0, points1, distance, scores0, scores1, real, size, size, ratio, confidence, *indices, *counts)
    return _pad(pair, np.nan, SLOTS)


def _pad(pair: Matches, garbage: float, slots: int) -> Matches:
    """Move the real matches to the front of `slots` slots, and fill the rest with `garbage`."""
    real, count = np.asarray(pair.mask), int(np.sum(pair.mask))

    def pad(values: np.ndarray) -> np.ndarray:
        fill = -1 if np.issubdtype(values.dtype, np.integer) else garbage
        rows = np.full((slots, *values.shape[1:]), fill, values.dtype)
        rows[:count] = values[real]
        return rows

    return replace(pair, mask=np.arange(slots) < count, **{n: pad(values) for n, values in per_match(pair).items()})
