"""Histogram of shifts (paper, section III-A): the tallest bin of a Gaussian-voted histogram of points1 - points0.

The Gaussian is a product of one along x and one along y, so all bins s_ij of a pair are one small matrix product,
`(w * votes_y) [By, K] @ votes_x [Bx, K]^T`, instead of K x By x Bx exponentials. Lengths are pixels.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from mfvpr.baselines.weight_registry import NAMED_WEIGHTS, SUFFIX
from mfvpr.core.lattice import Lattice, bin_scores, climb, pool_bins, smooth_tallest, tallest, votes
from mfvpr.core.parameters import SCORE, check_plain, choice, flag, integer, number, numbers, table_value
from mfvpr.core.shifts import are_finite, image_sizes, match_shifts, require_sizes, where_usable
from mfvpr.core.tallest import tallest_bins
from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import Weight, match_weights
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import compiled, is_concrete, positive, round_up

MAX_BINS = 1024  # per axis unless `max_bins` is larger: the histograms of 50 pairs then take 200 MB
CHUNK = 2**29  # bytes of the votes and bins that exist at the same time on an accelerator


class ShiftHistogram(NamedTuple):
    """Bin scores s_ij, -inf beyond the range of shifts, and bin centers in px.

    Example:
        scores, centers_x, centers_y = mfvpr.HistogramOfShifts().histogram(matches)
    """

    scores: Float[Array, "bins_y bins_x"]
    centers_x: Float[Array, " bins_x"]
    centers_y: Float[Array, " bins_y"]


@value
class HistogramOfShifts:
    """Score of the tallest bin of a histogram of shifts with Gaussian votes, equation 1.

        scorer = mfvpr.HistogramOfShifts(bin_size=15.0, sigma=22.5)
        scorer(matches), scorer.dominant_shift(matches, refine=True)  # score; (x, y) px

    The score is the maximum over bins (i, j) of

        s_ij = sum_k w_k exp(-((x_k - x_ij)^2 + (y_k - y_ij)^2) / (2 sigma^2)),

    where (x_k, y_k) is the shift of match k, w_k its weight, and (x_ij, y_ij) the center of the bin. The score does not
    change if all points of one image move by a multiple of `bin_size` while the peak stays in range. Numbers may be
    traced, batched and learned; `max_bins` and the choices are static.

    Attributes:
        bin_size: width of the square bins, px.
        sigma: standard deviation of the vote, px; the paper's 22.5 is read as 1.5 bins.
        weight: match weight, FS by default as in the paper.
        truncate: a match votes only for bins within this many sigmas along each axis (in the paper: for all bins).
        shift_range: (x, y): bins cover [-x, x] and [-y, y] px instead of all possible shifts.
        align: `min_edge` starts the first bin at the smallest possible shift; `zero_center` centers a bin on shift
            0; `zero_edge` puts an edge there.
        sigma_is_variance: read `sigma` as the variance, px^2.
        direction: shift of a match, candidate minus query point or the reverse.
        max_bins: capacity of bins per axis; by default as many as concrete values need, at most 1024. If image sizes
            or `bin_size` are traced, set it before `jit` or `vmap`, for instance by `with_capacity`; a histogram that
            then needs more bins scores NaN, never a wrong number.
        temperature: in units of the score; T > 0 scores T log(mean over bins of e^(s_ij / T)), at most the maximum
            and smooth in everything but the number of bins. None is the paper's maximum; an array
            not above 0 scores NaN.
    """

    bin_size: float | Array = number(15.0, "px")
    sigma: float | Array = number(22.5, "px", learned=True)
    weight: Weight = table_value(NAMED_WEIGHTS, "fs", file=SUFFIX)
    truncate: float | Array = number(math.inf, "sigmas", "vote only within so many; None = for all bins")
    shift_range: tuple[float, float] | None = numbers(
        None, 2, "[x, y] px", "None = all possible shifts", bounds=(0.0, 1e12)
    )
    align: str = choice("min_edge", "zero_center", "zero_edge")
    sigma_is_variance: bool = flag(False)
    direction: str = choice("candidate_minus_query", "query_minus_candidate")
    max_bins: int | None = integer(
        None, "capacity per axis", "None = what the image size needs", bounds=(1, MAX_BINS), swept=False
    )
    temperature: float | Array | None = number(
        None, SCORE, "above 0 is smooth; None = the paper's", learned=True, start=0.1
    )

    __post_init__ = check_plain

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32: the (smooth) maximum over bins, 0 without matches."""
        return self.scores_by_weights(matches, match_weights(self.weight, matches)[None])[0]

    def scores_by_weights(
        self, matches: Matches, weights: Float[Array, "weightings slots"]
    ) -> Float[jax.Array, " weightings"]:
        """Scores of one pair with several weights of its matches (0 on padding)."""
        shifts, lattice, capacity = self._shifts(matches), self._lattice(matches), self._capacity(matches)
        pool = tallest
        if self.temperature is not None:
            pool = partial(smooth_tallest, temperature=positive(self.temperature, shifts.dtype))
        scores = pool_bins(shifts, weights, lattice, capacity, pool)
        return where_usable(scores, matches, shifts, weights, lattice.usable(capacity))

    def batch_scores_by_weights(
        self, matches: Matches, weights: Float[Array, "candidates weightings slots"]
    ) -> Float[jax.Array, "candidates weightings"]:
        """`scores_by_weights` of pairs `[C, K, ...]`; on a CPU pair by pair, without most bins where that pays."""
        on_cpu = self._score_pair_by_pair if self.temperature is None else jax.vmap(self.scores_by_weights)
        return jax.lax.platform_dependent(matches, weights, cpu=on_cpu, default=self._score_in_chunks)

    def pairs_at_once(self, matches: Matches, num_weights: int) -> int:
        """Pairs whose weighted votes and bins fit `CHUNK`."""
        capacity = self._capacity(matches)
        return max(1, CHUNK // (4 * num_weights * capacity * (matches.mask.shape[-1] + capacity)))

    def _score_in_chunks(self, matches: Matches, weights: Array) -> Array:
        chunk_size = self.pairs_at_once(matches, weights.shape[1])
        return jax.lax.map(lambda pair: self.scores_by_weights(*pair), (matches, weights), batch_size=chunk_size)

    def _score_pair_by_pair(self, matches: Matches, weights: Array) -> Array:
        capacity, shifts = self._capacity(matches), jax.vmap(self._shifts)(matches)
        lattice = jax.vmap(self._lattice)(matches)
        scores = tallest_bins(shifts, weights, lattice, capacity)
        usable = jax.vmap(lambda lattice: lattice.usable(capacity))(lattice)
        return jax.vmap(where_usable)(scores, matches, shifts, weights, usable)

    def histogram(self, matches: Matches) -> ShiftHistogram:
        """All bins of one pair with their centers."""
        scores, lattice, usable = self._vote(matches)
        x, y = (lattice.centers(axis, jnp.arange(len(scores), dtype=scores.dtype)) for axis in (0, 1))
        return ShiftHistogram(jnp.where(usable, scores, jnp.nan), x, y)

    def dominant_shift(self, matches: Matches, *, refine: bool = False) -> Float[jax.Array, "2"]:
        """Shift of the tallest bin, (x, y) px, candidate minus query; (0, 0) without votes.

        It is the center of the tallest bin, the first in row-major order on a tie. With `refine` it is the peak
        between bin centers: the maximum of the same sum of Gaussians over all shifts that is uphill from that bin, to
        1e-4 sigma, within `shift_range`. The derivatives of the peak do not depend on the bins.
        """
        return _dominant_shift(self._fit_to(matches), matches, refine=refine)

    def shift_interval(
        self, matches: Matches, *, level: float = 0.95, sharpness: float = 24.0
    ) -> Float[jax.Array, "2 2"]:
        """Interval of the dominant shift, (low, high) of (x, y) px.

        The interval holds the central `level`, between 0 and 1 (else an InputError), of the mass s_ij^sharpness along
        each axis. It is wide if other bins are nearly as tall, and never narrower than `level` bins; without votes it
        is that part of all possible shifts. On three synthetic streets it contains the true shift of the same place in
        95 to 100 % of pairs at level 0.95, in 90 to 99 % at 0.68; with 5 px bins, sigma 10 in 72 to 100 %, 53 to 98 %.
        """
        if not 0 < level < 1:
            raise InputError(f"level={level}: expected a number between 0 and 1")
        return _shift_interval(self._fit_to(matches), matches, level, sharpness)

    def agrees(self, matches: Matches, shift: Float[Array, "2"]) -> Bool[jax.Array, " slots"]:
        """Matches within two standard deviations of a `shift` (x, y) px along both axes."""
        shifts = self._shifts(matches).T
        near = jnp.all(jnp.abs(shifts - shift[None]) <= 2 * self._deviation(shifts.dtype), axis=-1)
        return near & matches.mask

    def with_capacity(
        self, image_size0: Num[Array, "*batch0 2"], image_size1: Num[Array, "*batch1 2"], *, multiple: int = 1
    ) -> "HistogramOfShifts":
        """This scorer with `max_bins` set to the bins that its concrete values need, rounded up to a `multiple`.

        `bin_size` and the sizes may be batched: the capacity suffices for all of them. If more than 1024 bins are
        needed, or `bin_size` is not above 0, an `InputError` is raised.
        """
        return replace(self, max_bins=round_up(self._count_bins(image_size0, image_size1, most=MAX_BINS), multiple))

    def fit_capacity(self, image_size0: Array, image_size1: Array, multiple: int = 1) -> "HistogramOfShifts":
        """`with_capacity` if `max_bins` is not set, else an InputError if it is too small; unchanged if traced."""
        require_sizes(image_size0, image_size1)
        if not is_concrete((self.bin_size, self.shift_range, image_size0, image_size1)):
            return self
        if self.max_bins is None:
            return self.with_capacity(image_size0, image_size1, multiple=multiple)
        if self.max_bins < (needed := self._count_bins(image_size0, image_size1)):
            raise InputError(f"max_bins={self.max_bins}: expected at least {needed}, which images of this size need")
        return self

    def _count_bins(self, image_size0: Array, image_size1: Array, most: float = math.inf) -> int:
        finest = replace(self, bin_size=np.min(self.bin_size))
        if not finest.bin_size > 0:
            raise InputError(f"HistogramOfShifts(bin_size={finest.bin_size}): expected a number above 0")
        _, num_bins = finest._bin_range(image_size0, image_size1, float, np)
        needed = int(np.max(num_bins, where=np.isfinite(num_bins), initial=1))  # padding pairs may have any size
        if needed > most:
            raise InputError(
                f"bin_size={finest.bin_size:g}: expected at most {most} bins per axis, images of this size need "
                f"{needed}; use larger bins, or set max_bins"
            )
        return needed

    def _fit_to(self, matches: Matches) -> "HistogramOfShifts":
        if is_concrete(matches) and not np.asarray(matches.mask).any():  # the sizes may be anything
            return replace(self, max_bins=self.max_bins or min(self._count_bins(*image_sizes(matches)), MAX_BINS))
        return self.fit_capacity(matches.image_size0, matches.image_size1)

    def _vote(self, matches: Matches) -> tuple[Array, Lattice, Array]:
        """Scores `[B, B]` (y, x) of the bins, -inf out of range; bins; whether usable."""
        lattice, capacity = self._lattice(matches), self._capacity(matches)
        shifts, weights = self._shifts(matches), match_weights(self.weight, matches)
        scores = bin_scores(*votes(shifts, lattice, capacity), weights)
        usable = lattice.usable(capacity) & are_finite(shifts, weights[None])[0]
        return jnp.where(lattice.inside(capacity), scores, -jnp.inf), lattice, usable

    def _lattice(self, matches: Matches) -> Lattice:
        dtype = match_shifts(matches).dtype
        bin_size, truncate = (jnp.asarray(number, dtype=dtype) for number in (self.bin_size, self.truncate))
        first, num_bins = self._bin_range(*image_sizes(matches), dtype, jnp)
        return Lattice(first, num_bins, bin_size, self._deviation(dtype), truncate)

    def _capacity(self, matches: Matches) -> int:
        capacity = self._fit_to(matches).max_bins
        if capacity is None:
            raise ValueError(
                "HistogramOfShifts: the number of bins must be known before image sizes or bin_size are traced; set "
                "max_bins=, or call with_capacity(image_size0, image_size1), before jit, vmap or grad"
            )
        return capacity

    def _bin_range(self, image_size0: Array, image_size1: Array, dtype: Any, xp: Any) -> tuple[Array, Array]:
        """Center of the first bin and number of bins, `[..., 2]` (x, y), in NumPy or JAX (`xp`)."""
        lower, upper = -xp.asarray(image_size0, dtype=dtype), xp.asarray(image_size1, dtype=dtype)
        if self.direction == "query_minus_candidate":
            lower, upper = -upper, -lower
        if self.shift_range is not None:
            upper = xp.asarray(self.shift_range, dtype=dtype)
            lower = -upper
        bin_size = xp.asarray(self.bin_size, dtype=dtype)[..., None]
        slack = 1e-4  # bins: rounding must not add an empty bin
        if self.align == "min_edge":
            edge = lower
        elif self.align == "zero_center":
            edge = (xp.floor(lower / bin_size + 0.5 + slack) - 0.5) * bin_size
        else:
            edge = xp.floor(lower / bin_size + slack) * bin_size
        num_bins = xp.maximum(xp.ceil((upper - edge) / bin_size - slack), 1)
        return edge + bin_size / 2, xp.where((bin_size > 0) & (lower <= upper), num_bins, 0)

    def _shifts(self, matches: Matches) -> Float[Array, "2 slots"]:
        """Shifts along x and along y."""
        shifts = match_shifts(matches).T
        # The barrier keeps the copy: strided coordinates would keep the exponentials from being vectorized.
        return jax.lax.optimization_barrier(shifts if self.direction == "candidate_minus_query" else -shifts)

    def _deviation(self, dtype: Any) -> Array:
        sigma = positive(self.sigma, dtype)
        return jnp.sqrt(sigma) if self.sigma_is_variance else sigma


@partial(compiled, static_argnames="refine")  # uncompiled, the loop of `climb` would be compiled at every call
def _dominant_shift(scorer: HistogramOfShifts, matches: Matches, *, refine: bool) -> Array:
    scores, lattice, usable = scorer._vote(matches)
    row, column = jnp.unravel_index(jnp.argmax(scores), scores.shape)
    shift = jnp.stack([lattice.centers(axis, bin.astype(scores.dtype)) for axis, bin in enumerate((column, row))])
    shifts, weights = scorer._shifts(matches).T, match_weights(scorer.weight, matches)
    if refine:
        shift = climb(shift, shifts, weights, scorer._deviation(shifts.dtype))
        if scorer.shift_range is not None:
            reach = jnp.asarray(scorer.shift_range, shift.dtype)
            shift = jnp.clip(shift, -reach, reach)
    shift = jnp.where(jnp.max(scores) > 0, shift, 0.0)
    return where_usable(shift, matches, shifts, weights[None], usable)


@compiled
def _shift_interval(scorer: HistogramOfShifts, matches: Matches, level: Array, sharpness: Array) -> Array:
    """`shift_interval`. The mass of a bin below 0 is that of 0; without votes all bins in range have the same mass."""
    scores, lattice, usable = scorer._vote(matches)
    level, sharpness = (jnp.asarray(number, scores.dtype) for number in (level, sharpness))
    heights, in_range = jnp.maximum(scores, 0.0), (scores > -jnp.inf).astype(scores.dtype)
    top = jnp.max(heights)
    mass = jnp.where(top > 0, (heights / jnp.where(top > 0, top, 1.0)) ** sharpness, in_range)
    tail = (1 - level) / 2
    edges = jnp.arange(len(scores) + 1, dtype=scores.dtype) - 0.5  # in bins

    def along(axis: int) -> Array:
        below = jnp.concatenate([jnp.zeros(1, scores.dtype), jnp.cumsum(jnp.sum(mass, axis=axis))])
        return jnp.interp(jnp.stack([tail, 1 - tail]), below / below[-1], lattice.centers(axis, edges))

    return jnp.where(usable, jnp.stack([along(0), along(1)], axis=1), jnp.nan)
