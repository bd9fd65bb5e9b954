"""Array helpers of all packages: masked reductions, safe roots, `compiled`, and properties of devices."""

import os
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Num, Shaped

from mfvpr.utils.errors import InputError

if TYPE_CHECKING:  # type checkers do not see that `jax.Device` is a class
    from jaxlib._jax import Device

    Array = Any
else:
    Device = jax.Device
    Array = jax.Array | np.ndarray | np.generic

_CPUINFO = Path("/proc/cpuinfo")
_HOST = 1  # DLPack's number of the processor

Function = TypeVar("Function", bound=Callable[..., Any])


def masked(values: Shaped[Array, "..."], mask: Bool[Array, "..."], fill: ArrayLike = 0.0) -> Shaped[jax.Array, "..."]:
    """`values` where `mask`, `fill` elsewhere; trailing axes of `values` that `mask` lacks are broadcast.

        jnp.sum(2.0 - mfvpr.masked(matches.distance, matches.mask, 2.0))

    Padding may hold NaN: apply this before any arithmetic, or gradients turn NaN as well.
    """
    extra = values.ndim - mask.ndim
    return jnp.where(mask.reshape(mask.shape + (1,) * extra), values, fill)


def as_array(values: Any) -> Any:
    """`values`; lists as NumPy's arrays, arrays of other libraries (DLPack) as NumPy's, or JAX's on an accelerator.

    An `InputError` for a masked NumPy array, whose mask would be lost.
    """
    if np.ma.is_masked(values):
        mend = "leave them out, for instance by array.compressed()"
        raise InputError(f"arrays: expected arrays without a mask of NumPy, got masked entries; {mend}")
    if not _is_foreign(values):
        return np.asarray(values) if isinstance(values, list | tuple) else values
    values = values.detach() if hasattr(values, "detach") else values  # torch exports no tensor that needs a gradient
    on_host = values.__dlpack_device__()[0] == _HOST
    try:
        return np.from_dlpack(values) if on_host else jnp.from_dlpack(values)
    except (BufferError, RuntimeError, TypeError, ValueError):  # bfloat16, or an accelerator that JAX does not use
        return jnp.from_dlpack(values) if on_host else np.from_dlpack(values.cpu())


def _is_foreign(values: Any) -> bool:
    return hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray | jax.Array)


def as_float(values: ArrayLike) -> Float[jax.Array, "..."]:
    """`values` of floating point unchanged, other values in the default float type."""
    values = jnp.asarray(values)
    return values if jnp.issubdtype(values.dtype, jnp.floating) else values.astype(float)


def at_least_single(values: ArrayLike) -> Float[jax.Array, "..."]:
    """`values` as `as_float`, and float16 or bfloat16 as float32, which holds their products exactly."""
    values = as_float(values)
    return values.astype(jnp.float32) if jnp.finfo(values.dtype).bits < 32 else values


def positive(value: ArrayLike | None, dtype: Any) -> Float[jax.Array, "..."]:
    """A width or a temperature if it is above 0, else NaN, which makes the score NaN."""
    value = jnp.asarray(value, dtype=dtype)
    return jnp.where(value > 0, value, jnp.nan)


def masked_mean(
    values: Float[Array, " entries *rest"],
    mask: Bool[Array, " entries"],
    weights: Num[Array, " entries"] | None = None,
) -> Float[jax.Array, "*rest"]:
    """(Weighted) mean of `values` over axis 0 where `mask` is True; 0 if there are none.

    Example:
        mfvpr.masked_mean(mfvpr.match_shifts(matches), matches.mask, weights=matches.scores0)  # (x, y)
    """
    weights = masked(jnp.ones(mask.shape, values.dtype) if weights is None else weights, mask)
    total = jnp.sum(weights)
    weighted = masked(values, mask) * weights.reshape(weights.shape + (1,) * (values.ndim - 1))
    return jnp.sum(weighted, axis=0) / jnp.where(total == 0, 1.0, total)


def masked_median(values: Float[Array, " entries *rest"], mask: Bool[Array, " entries"]) -> Float[jax.Array, "*rest"]:
    """Median of `values` over axis 0 where `mask` is True (mean of the middle two when even); 0 if there are none.

    Example:
        mfvpr.masked_median(jnp.array([1.0, 9.0, 2.0, 7.0]), jnp.array([True, False, True, True]))  # 2.0
    """
    if len(mask) == 0:
        return jnp.zeros(values.shape[1:], values.dtype)
    ordered = jnp.sort(masked(values, mask, jnp.inf), axis=0)
    real = jnp.sum(mask)
    middle = (ordered[jnp.maximum(real - 1, 0) // 2] + ordered[jnp.minimum(real // 2, len(mask) - 1)]) / 2
    return jnp.where(real > 0, middle, 0.0)


def where_finite(score: Float[Array, "*batch"], *inputs: Num[Array, "..."]) -> Float[jax.Array, "*batch"]:
    """`score` if all inputs are finite, else NaN, which ranks last."""
    return jnp.where(jnp.all(jnp.stack([jnp.all(jnp.isfinite(values)) for values in inputs])), score, jnp.nan)


def safe_sqrt(squared: Float[Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Square root of max(x, 0), where x is `squared`; its gradient at 0 is 0 instead of infinite; NaN of NaN.

    Example:
        mfvpr.safe_sqrt(jnp.sum(mfvpr.match_shifts(matches) ** 2, axis=-1))  # [K] lengths, px
    """
    is_zero = squared <= 0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, squared)))


def round_up(size: int, multiple: int) -> int:
    """The smallest multiple of `multiple` that is at least `size`, and at least one `multiple`."""
    return max(1, -(-size // multiple)) * multiple


def repeat_last(values: Shaped[np.ndarray, " _ *rest"], total: int) -> Shaped[np.ndarray, " _ *rest"]:
    """`values`, at least one, with the last entry repeated up to `total` entries."""
    return np.concatenate([values, np.repeat(values[-1:], total - len(values), axis=0)])


def compiled(function: Function, **options: Any) -> Function:
    """`jax.jit` for functions of many pairs; the classes of all nodes of the arguments choose the program as well.

    With a plain function among the arguments, such as a user's scorer, it runs op by op: a cached program would keep
    the values of the closure from the first call. Scorers that are called often: see `with_static_functions`.
    """
    programs: dict[tuple[type, ...], Any] = {}

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        nodes: list[Any] = []  # parents first
        leaves = jax.tree.leaves((arguments, named), is_leaf=lambda node: bool(nodes.append(node)))  # never true
        if any(map(_is_foreign, leaves)):
            arguments, named = jax.tree.map(as_array, (arguments, named))
        if any(map(callable, leaves)):
            return function(*arguments, **named)
        # Up to jaxlib 0.10 tree structures are equal whatever the classes that `register_dataclass` registered.
        of_leaves = set(map(type, leaves))
        classes = tuple([cls for cls in map(type, nodes) if cls not in of_leaves])
        if classes not in programs:  # `jit` shares programs between equal functions, and a `partial` equals no other
            programs.setdefault(classes, jax.jit(partial(function), **options))
        return programs[classes](*arguments, **named)

    return call  # pyright: ignore[reportReturnType]


def holds_function(tree: Any) -> bool:
    """Whether a leaf is a plain function, such as a user's scorer."""
    return any(map(callable, jax.tree.leaves(tree)))


def is_concrete(tree: Any) -> bool:
    """True if no leaf is traced, so that Python may look at the values."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def knows_own_context() -> bool:
    """Whether a new thread has the settings of this one: not within `with jax.enable_x64(True)` and its like."""
    with ThreadPoolExecutor(1) as fresh:
        return dict(jax.config.values) == fresh.submit(lambda: dict(jax.config.values)).result()


def processor_info() -> str:
    """Description of the processor by Linux; empty elsewhere."""
    return _CPUINFO.read_text() if _CPUINFO.exists() else ""


@cache
def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 faster than float32, as far as is known (Linux, x86-64)."""
    return "avx512_bf16" in processor_info()


def available_cpus() -> int:
    """Processors that this process may use: a scheduler or container may give fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def device_bytes(tree: Any) -> int | None:
    """Memory of the device of the first array; None for a processor, which has no memory of its own."""
    return (device_of(tree).memory_stats() or {}).get("bytes_limit")


def free_bytes(device: Device) -> int:
    """Free bytes in the memory of a device: its own, or the machine's."""
    stats = device.memory_stats()
    return stats["bytes_limit"] - stats["bytes_in_use"] if stats else free_host_bytes()


def free_host_bytes() -> int:
    """Free bytes of the machine's memory, caches of files included; all of it if the system does not say."""
    try:
        return 1024 * int(re.findall(r"MemAvailable: *(\d+)", Path("/proc/meminfo").read_text())[0])
    except (OSError, IndexError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def device_of(tree: Any) -> Device:
    """Device of the first array; without arrays, JAX's default."""
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer):
            return next(iter(leaf.devices()))
    default = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return default if isinstance(default, Device) else jax.local_devices(backend=default)[0]
