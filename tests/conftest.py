"""Strict arithmetic for every test: no silent rank promotion, warnings are errors (pyproject.toml)."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from hypothesis import settings

from mfvpr.data.streets import streets_folder
from mfvpr.weights.conversion import convert
from mfvpr.weights.files import save
from mfvpr.weights.networks import blueprint, network_of
from mfvpr.weights.registry import entry_of
from tests import checkpoints

# A shell ignores Ctrl-C for what it runs in the background; the tests of Ctrl-C need it there too.
signal.signal(signal.SIGINT, signal.default_int_handler)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compiled programs are shared by this process, those it starts, and the next run.
COMPILED = Path(__file__).parent.parent / ".pytest_cache" / "xla"
for name, value in (
    ("jax_compilation_cache_dir", str(COMPILED)),
    ("jax_persistent_cache_min_compile_time_secs", 0.0),
    ("jax_persistent_cache_min_entry_size_bytes", -1),
):
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)
settings.register_profile("mfvpr", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("mfvpr")


class Compilations:
    """How many programs XLA compiled since the last `reset`."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, _: float, **__: object) -> None:
        self.count += event == "/jax/core/compile/backend_compile_duration"

    def reset(self) -> None:
        self.count = 0


_compilations = Compilations()


@pytest.fixture
def compilations() -> Compilations:
    _compilations.reset()
    return _compilations


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """A compiled program takes several of the 65,530 memory maps that Linux gives a process; XLA dies without."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory) -> Iterator[None]:
    """Nothing of the user's cache is read or written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Path:
    """A folder of installed weights: random ones, but ALIKED's real ones where they are at hand."""
    root = tmp_path_factory.mktemp("weights")
    for name, tensors in checkpoints.at_hand():
        entry, source = entry_of(name), root / f"{name}.source"
        source.write_text("not published")
        plan = blueprint(entry)
        arrays = convert(tensors, network_of(entry).table, plan.shapes)
        save(name, arrays, source, parameters=plan.parameters, folder=root)
    return root


@pytest.fixture(scope="session")
def small_street(tmp_path_factory) -> Path:
    """Ten frames of the drawn street: database/, queries/, ground_truth.csv."""
    return streets_folder(tmp_path_factory.mktemp("cache"), num_frames=10, image_size=(320, 240))


@pytest.fixture(scope="session")
def split(small_street, tmp_path_factory) -> list[Path]:
    """The queries in two folders, 3 and 7 of them, with the rows of the database that they show."""
    root = tmp_path_factory.mktemp("split")
    for name, rows in (("first", range(3)), ("second", range(3, 10))):
        (root / name).mkdir()
        for row in rows:
            shutil.copy(small_street / "queries" / f"{row:04d}.png", root / name)
        lines = [f"{row:04d}.png,{row:04d}.png\n" for row in rows]
        (root / name / "truth.csv").write_text("query,database\n" + "".join(lines))
    return [root / "first", root / "second"]
