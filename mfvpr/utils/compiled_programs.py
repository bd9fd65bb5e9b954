"""Compiled programs that stay on disk between processes, by JAX's persistent compilation cache."""

import math
import os
import platform
import re
import stat
import warnings
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from mfvpr.utils.fields import one_of
from mfvpr.utils.fingerprints import versions
from mfvpr.utils.numerics import processor_info

VARIABLE = "MFVPR_COMPILED"
_PROCESSOR = r"^(?:vendor_id|cpu family|model|flags|CPU implementer|CPU part|Features|cpu|isa)\s*:.*$"


def keep_compiled_programs(warn: Callable[[str], object] = warnings.warn) -> None:
    """Let JAX read compiled programs from disk, and write new ones there, for the rest of this process.

    They lie in a subfolder of `$MFVPR_CACHE/compiled`, by default `~/.cache/mfvpr/compiled`, for each processor and
    version. Where it cannot be written, it is only read. Nothing changes with `MFVPR_COMPILED=false`, without a home
    folder or `MFVPR_CACHE`, or if JAX has a folder of its own (`jax_compilation_cache_dir`) or no compilation cache.
    A folder that another user owns (except root) or can write to is not used, and `warn` gets a line once.
    """
    is_on, config = os.environ.get(VARIABLE) or "true", dict[str, Any](jax.config.values)
    one_of("true", "false").check(VARIABLE, is_on)
    if is_on == "false" or config["jax_compilation_cache_dir"] or not config["jax_enable_compilation_cache"]:
        return
    folder = _folder()
    if folder.parts[0] == "~":  # no home folder
        return
    try:
        folder.mkdir(0o755, parents=True, exist_ok=True)
        states = {path: path.stat() for path in (folder, *folder.parents[:2])}
    except OSError:
        return
    for path, state in states.items():
        others = 0o022 if path == folder else 0 if state.st_mode & stat.S_ISVTX else 0o002  # sticky, such as /tmp
        if state.st_uid not in {0, os.getuid()} or state.st_mode & others:
            expected = "a folder that is yours and that nobody else can write to, as it holds machine code"
            mend = "compiled programs are not kept; run `chmod go-w` on it, or set MFVPR_CACHE"
            warn(f"{path}: expected {expected}; {mend}")
            os.environ[VARIABLE] = "false"  # also for later calls and child processes
            return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    seconds = 0.0 if os.access(folder, os.W_OK) else math.inf  # of a compilation, from which on it is written
    jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)
    compilation_cache.reset_cache()  # JAX looks for a folder once, at the first compilation


def _folder() -> Path:
    """The folder of programs for this processor and these versions."""
    root = os.path.expanduser(os.environ.get("MFVPR_CACHE") or "~/.cache/mfvpr")
    lines = re.findall(_PROCESSOR, processor_info(), re.MULTILINE)
    processor = sha256("\n".join(sorted({*lines}) or [platform.node()]).encode()).hexdigest()[:16]
    packages = [f"{name}-{versions()[name]}" for name in ("mfvpr", "jax", "jaxlib")]
    return Path(root, "compiled", "_".join([*packages, platform.machine(), processor]))
