"""Histogram of shifts (paper, section III-A): the tallest bin of a Gaussian-voted histogram of points1 - points0.

The Gaussian is a product of one along x and one along y, so all bins s_ij of a pair are one small matrix product,
`(w * votes_y) [By, K] @ votes_x [Bx, K]^T`, instead of K x By x Bx exponentials. Lengths are pixels.

In this order: the score, what else the histogram says (all bins, the dominant shift, its interval), the bins and their
number, and the peak between bins.
"""

import math
from dataclasses import field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from mfvpr.core.scorer import SCORE
from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import Weight, image_sizes, match_shifts, match_weights, require_sizes, weight_field
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, NOT_NEGATIVE, POSITIVE, check_fields, list_of, one_of, setting, whole
from mfvpr.utils.numerics import compiled, device_of, is_concrete, masked, positive, round_up, safe_sqrt

MAX_BINS = 1024  # per axis unless `max_bins` is larger: the histograms of 50 pairs then take 200 MB
PAIRS_AT_ONCE = 8  # on a CPU, divided by the weightings: few and long operations that still stay in the cache
CHUNK = 2**29  # bytes of the votes and bins that exist at the same time on an accelerator
_NEAR = 32.0  # temperatures; e^32 is far from overflow
_MOST_STEPS = 100  # uphill; hardly any pair needs 10
_TOLERANCE = 1e-4  # of the peak, standard deviations


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
            and smooth in everything but the number of bins. None is the paper's maximum; an array not above 0 is NaN.
    """

    bin_size: float | Array = setting(15.0, POSITIVE, unit="px")
    sigma: float | Array = setting(22.5, POSITIVE, unit="px", learned=True)
    weight: Weight = weight_field("fs")
    truncate: float | Array = setting(
        math.inf, POSITIVE | None, "vote only within so many; None = for all bins", unit="sigmas", none=math.inf
    )
    shift_range: tuple[float, float] | None = setting(
        None, list_of(NOT_NEGATIVE, 2) | None, "None = all possible shifts", unit="[x, y] px", swept=False
    )
    align: str = setting("min_edge", one_of("min_edge", "zero_center", "zero_edge"), static=True)
    sigma_is_variance: bool = setting(False, FLAG, static=True)
    direction: str = setting(
        "candidate_minus_query", one_of("candidate_minus_query", "query_minus_candidate"), static=True
    )
    max_bins: int | None = setting(
        None,
        whole(1, 2**14) | None,  # 2^14 x 2^14 bins are 1 GB
        "None = what the image size needs",
        unit="capacity per axis",
        swept=False,
        static=True,
    )
    temperature: float | Array | None = setting(
        None, POSITIVE | None, "above 0 is smooth; None = the paper's", unit=SCORE, learned=True, start=0.1
    )

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32: the (smooth) maximum over bins, 0 without matches."""
        bins, weights = self._bins(matches), match_weights(self.weight, matches)[None]
        return bins.where_usable(self._maxima(bins, weights), matches, weights)[0]

    def _maxima(self, bins: "_Bins", weights: Float[Array, "weightings slots"]) -> Float[jax.Array, " weightings"]:
        """The (smooth) maximum over bins of one pair for each weighting of its matches (0 on padding)."""
        scores = bins.scores(weights)
        if self.temperature is None:
            return jnp.max(scores, axis=(1, 2))  # of all: bins beyond the last only repeat it
        smooth = partial(smooth_maximum, mask=bins.inside, temperature=positive(self.temperature, scores.dtype))
        return jax.vmap(smooth)(scores)

    def score_weightings(
        self, matches: Matches, weights: Float[Array, "candidates weightings slots"]
    ) -> Float[jax.Array, "candidates weightings"]:
        """Scores of candidates `[C, K, ...]` with several weights of their matches, which share the Gaussians."""
        bins, size = jax.vmap(self._bins)(matches), self.pairs_at_once(matches, weights.shape[1])
        maxima = jax.lax.map(lambda pair: self._maxima(*pair), (bins, weights), batch_size=size)
        return jax.vmap(_Bins.where_usable)(bins, maxima, matches, weights)

    def pairs_at_once(self, matches: Matches, num_weightings: int) -> int:
        """Pairs whose votes and bins are to exist at the same time."""
        if device_of(()).platform == "cpu":
            return max(1, PAIRS_AT_ONCE // num_weightings)
        capacity = self._capacity(matches)
        return max(1, CHUNK // (4 * num_weightings * capacity * (matches.mask.shape[-1] + capacity)))

    def histogram(self, matches: Matches) -> ShiftHistogram:
        """All bins of one pair with their centers."""
        scores, bins, weights = self._vote(matches)
        scores = jnp.where(bins.are_usable(weights), scores, jnp.nan)
        return ShiftHistogram(scores, *(bins.centers(axis, bins.index) for axis in (0, 1)))

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
        """`fit_capacity` to one pair, before `jit` hides its sizes; without matches they may be anything."""
        if is_concrete(matches) and not np.asarray(matches.mask).any():
            return replace(self, max_bins=self.max_bins or min(self._count_bins(*image_sizes(matches)), MAX_BINS))
        return self.fit_capacity(matches.image_size0, matches.image_size1)

    def _capacity(self, matches: Matches) -> int:
        capacity = self._fit_to(matches).max_bins
        if capacity is None:
            raise ValueError(
                "HistogramOfShifts: the number of bins must be known before image sizes or bin_size are traced; set "
                "max_bins=, or call with_capacity(image_size0, image_size1), before jit, vmap or grad"
            )
        return capacity

    def _bin_range(self, image_size0: Array, image_size1: Array, dtype: Any, xp: Any) -> tuple[Array, Array]:
        """Center of the first bin and number of bins, `[..., 2]` (x, y): by NumPy for a capacity, else by JAX."""
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

    def _bins(self, matches: Matches) -> "_Bins":
        shifts = self._shifts(matches)
        bin_size, truncate = (jnp.asarray(number, dtype=shifts.dtype) for number in (self.bin_size, self.truncate))
        first, num_bins = self._bin_range(*image_sizes(matches), shifts.dtype, jnp)
        deviation = self._deviation(shifts.dtype)
        return _Bins(shifts, first, num_bins, bin_size, deviation, truncate, self._capacity(matches))

    def _vote(self, matches: Matches) -> tuple[Float[Array, "bins bins"], "_Bins", Float[Array, " slots"]]:
        """Scores of the bins (y, x), -inf out of range; the bins, and the weights of the matches."""
        bins, weights = self._bins(matches), match_weights(self.weight, matches)
        return jnp.where(bins.inside, bins.scores(weights[None])[0], -jnp.inf), bins, weights

    def _shifts(self, matches: Matches) -> Float[Array, "2 slots"]:
        """Shifts along x and along y."""
        shifts = match_shifts(matches).T
        # The barrier keeps the copy: strided coordinates would keep the exponentials from being vectorized.
        return jax.lax.optimization_barrier(shifts if self.direction == "candidate_minus_query" else -shifts)

    def _deviation(self, dtype: Any) -> Array:
        sigma = positive(self.sigma, dtype)
        return jnp.sqrt(sigma) if self.sigma_is_variance else sigma


@value
class _Bins:
    """Shifts of one pair, the bins that they vote for, and the width of the votes, px."""

    shifts: Float[Array, "2 slots"]  # (x, y)
    first_center: Float[Array, "2"]  # (x, y), of the first bin
    num_bins: Float[Array, "2"]
    bin_size: Float[Array, ""]
    deviation: Float[Array, ""]  # sigma of equation 1
    truncate: Float[Array, ""]  # sigmas
    capacity: int = field(metadata={"static": True})

    @property
    def index(self) -> Float[Array, " bins"]:
        """Numbers of bins along an axis."""
        return jnp.arange(self.capacity, dtype=self.first_center.dtype)

    def centers(self, axis: int, index: Array) -> Array:
        """Centers of bins along an axis, px, by bin number."""
        return self.first_center[axis] + index * self.bin_size

    def votes(self, axis: int) -> Float[Array, "bins slots"]:
        """Votes exp(-d^2 / (2 sigma^2)) of the shifts along one axis, without weights."""
        index = jnp.minimum(self.index, self.num_bins[axis] - 1)  # repeats the last bin, which changes no maximum
        # Bins along rows: the exponentials then run along K, which is longer and contiguous (1.8x faster).
        sigmas = (self.centers(axis, index)[:, None] - self.shifts[axis][None]) / self.deviation
        return jnp.where(jnp.abs(sigmas) > self.truncate, 0.0, jnp.exp(-0.5 * sigmas**2))

    @property
    def inside(self) -> Bool[Array, "bins bins"]:
        """(y, x), True for bins within the range of shifts."""
        return (self.index < self.num_bins[1])[:, None] & (self.index < self.num_bins[0])[None]

    def scores(self, weights: Float[Array, "weightings slots"]) -> Float[Array, "weightings bins bins"]:
        """s_ij of equation 1, (y, x), by weighting: one product of all weighted votes along y and those along x."""
        votes_x, votes_y = self.votes(0), self.votes(1)
        rows = (weights[:, None] * votes_y[None]).reshape(len(weights) * len(votes_y), weights.shape[1])
        sums = jnp.matmul(rows, votes_x.T, precision=jax.lax.Precision.HIGHEST)
        return sums.reshape(len(weights), len(votes_y), len(votes_x))

    def are_usable(self, weights: Float[Array, "*weightings slots"]) -> Bool[Array, "*weightings"]:
        """Whether the bins fit the capacity, and `deviation`, `truncate`, shifts and weights are numbers."""
        # Checked here, because XLA's maximum over thousands of values on a CPU skips NaN.
        fits = jnp.all((self.num_bins >= 1) & (self.num_bins <= self.capacity))
        numbers = ~jnp.isnan(self.deviation) & ~jnp.isnan(self.truncate) & jnp.all(jnp.isfinite(self.shifts))
        return fits & numbers & jnp.all(jnp.isfinite(weights), axis=-1)

    def where_usable(self, values: Array, matches: Matches, weights: Array) -> Array:
        """Values of one pair, for each weighting or of one; 0 without matches, NaN where not `are_usable`."""
        usable = self.are_usable(weights)
        return jnp.where(jnp.any(matches.mask), jnp.where(usable, values, jnp.nan), 0.0)


def smooth_maximum(
    values: Float[Array, "*bins"], mask: Bool[Array, "*bins"], *, temperature: Array
) -> Float[Array, ""]:
    """T log(mean of e^(v / T)) of the values where `mask`; the others are within the range of these."""
    # Relative to the maximum nothing overflows. The maximum drops out, so that its gradient would be 0.
    largest = jax.lax.stop_gradient(jnp.max(values))
    below = (masked(values, mask, largest) - largest) / temperature
    far = largest + temperature * jnp.log(jnp.mean(jnp.exp(below), where=mask))
    # Where the sum of both terms would cancel: small values, or one peak in many bins.
    is_near = (largest <= _NEAR * temperature) & (jnp.min(values) >= -temperature)
    ratios = masked(values / temperature, mask & is_near)
    return jnp.where(is_near, temperature * jnp.log1p(jnp.mean(jnp.expm1(ratios), where=mask)), far)


@partial(compiled, static_argnames="refine")  # uncompiled, the loop of `climb` would be compiled at every call
def _dominant_shift(scorer: HistogramOfShifts, matches: Matches, *, refine: bool) -> Array:
    scores, bins, weights = scorer._vote(matches)
    row, column = jnp.unravel_index(jnp.argmax(scores), scores.shape)
    shift = jnp.stack([bins.centers(axis, bin.astype(scores.dtype)) for axis, bin in enumerate((column, row))])
    if refine:
        shift = climb(shift, bins.shifts.T, weights, bins.deviation)
        if scorer.shift_range is not None:
            reach = jnp.asarray(scorer.shift_range, shift.dtype)
            shift = jnp.clip(shift, -reach, reach)
    shift = jnp.where(jnp.max(scores) > 0, shift, 0.0)
    return bins.where_usable(shift, matches, weights[None])


@compiled
def _shift_interval(scorer: HistogramOfShifts, matches: Matches, level: Array, sharpness: Array) -> Array:
    """`shift_interval`. The mass of a bin below 0 is that of 0; without votes all bins in range have the same mass."""
    scores, bins, weights = scorer._vote(matches)
    level, sharpness = (jnp.asarray(number, scores.dtype) for number in (level, sharpness))
    heights, in_range = jnp.maximum(scores, 0.0), (scores > -jnp.inf).astype(scores.dtype)
    top = jnp.max(heights)
    mass = jnp.where(top > 0, (heights / jnp.where(top > 0, top, 1.0)) ** sharpness, in_range)
    tail = (1 - level) / 2
    edges = jnp.arange(len(scores) + 1, dtype=scores.dtype) - 0.5  # in bins

    def along(axis: int) -> Array:
        below = jnp.concatenate([jnp.zeros(1, scores.dtype), jnp.cumsum(jnp.sum(mass, axis=axis))])
        return jnp.interp(jnp.stack([tail, 1 - tail]), below / below[-1], bins.centers(axis, edges))

    return jnp.where(bins.are_usable(weights), jnp.stack([along(0), along(1)], axis=1), jnp.nan)


def climb(
    start: Float[Array, "2"],
    shifts: Float[Array, "slots 2"],
    weights: Float[Array, " slots"],
    deviation: Float[Array, ""],
) -> Float[Array, "2"]:
    """Maximum of sum_k w_k exp(-|s - s_k|^2 / (2 sigma^2)) uphill from s = `start`, to 1e-4 sigma.

    Each step is Newton's or that of mean shift, whichever ends higher. First and second derivatives are exact.
    """
    fixed = jax.lax.stop_gradient((shifts, weights, deviation))

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, shift, (newton, mean_shift) = state
        newton = newton * jnp.minimum(1.0, fixed[2] / jnp.sqrt(jnp.sum(newton**2)))
        heights = [jnp.sum(_pull(shift + move, *fixed)[1]) for move in (newton, mean_shift)]
        shift = shift + jnp.where(heights[0] >= heights[1], newton, mean_shift)
        return number + 1, shift, _steps(shift, *fixed)

    def is_climbing(state: tuple[Array, Array, Array]) -> Array:
        number, _, (newton, _) = state
        return (number < _MOST_STEPS) & (jnp.sqrt(jnp.sum(newton**2)) > _TOLERANCE * fixed[2])

    start = jax.lax.stop_gradient(start)
    _, shift, _ = jax.lax.while_loop(is_climbing, step, (jnp.zeros((), jnp.int32), start, _steps(start, *fixed)))
    for _ in range(2):  # each Newton step doubles the order up to which derivatives are correct
        shift = shift + _steps(shift, shifts, weights, deviation)[0]
    return shift


def _pull(shift: Array, shifts: Array, weights: Array, deviation: Array) -> tuple[Array, Array]:
    """Offsets of the matches from a shift, and their weighted votes for it."""
    offsets = shifts - shift[None]
    return offsets, weights * jnp.exp(-0.5 * jnp.sum((offsets / deviation) ** 2, axis=-1))


def _steps(shift: Array, shifts: Array, weights: Array, deviation: Array) -> Float[Array, "2 2"]:
    """Newton's step and the step of mean shift (Comaniciu & Meer, PAMI 2002), px; 0 without votes.

    Where the sum is not concave, a multiple of the identity in the Hessian makes Newton's step lead uphill.
    """
    offsets, pull = _pull(shift, shifts, weights, deviation)
    total = jnp.sum(pull)
    pull = jnp.where(total > 0, pull / jnp.where(total > 0, total, 1.0), 0.0)[:, None]
    mean, scaled = jnp.sum(pull * offsets, axis=0), offsets / deviation
    xx, yy = 1 - jnp.sum(pull * scaled**2, axis=0)
    xy = -jnp.sum(pull[:, 0] * scaled[:, 0] * scaled[:, 1])
    smallest = (xx + yy) / 2 - safe_sqrt(((xx - yy) / 2) ** 2 + xy**2)  # eigenvalue
    damping = 2 * jnp.maximum(-smallest, 0.0)
    xx, yy = xx + damping, yy + damping
    determinant = xx * yy - xy**2
    newton = jnp.stack([yy * mean[0] - xy * mean[1], xx * mean[1] - xy * mean[0]])
    newton = jnp.where(determinant > 0, newton / jnp.where(determinant > 0, determinant, 1.0), mean)
    return jnp.stack([newton, mean])
