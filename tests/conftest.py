"""Strict arithmetic for every test: no silent rank promotion, warnings are errors (pyproject.toml)."""

import gc
import os
import shutil
import signal
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

from mfvpr import datasets
from mfvpr.checkpoints import entry_of
from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import convert
from mfvpr.checkpoints.files import save
from mfvpr.checkpoints.networks import plan_network
from mfvpr.datasets import Dataset
from mfvpr.datasets.streets import streets_folder
from tests import random_checkpoints
from tests.builders import read_golden
from tests.needs import ALIKED, EXTRAS, LIGHTGLUE, OF_A_CLONE, is_at_hand, reason, skip_without

gc.set_threshold(50_000, 20, 100)  # tracing makes many objects, and the usual thresholds collect too often
# A shell ignores Ctrl-C for what it runs in the background; the tests of Ctrl-C need it there too.
signal.signal(signal.SIGINT, signal.default_int_handler)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compiled programs are shared by this process, those it starts, and the next run.
COMPILED = Path(__file__).parent.parent / ".xla_cache"
MOST_MEMORY_MAPS = 30_000  # Linux gives a process 65,530, a compiled program takes several, and XLA dies without


def configure_jax(name: str, value: object) -> None:
    """Set an option of JAX for this process and for those it starts."""
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)


def count_memory_maps() -> int:
    """Memory maps of this process; 0 on systems that do not list them, and have no such limit."""
    maps = Path("/proc/self/maps")
    return len(maps.read_bytes().splitlines()) if maps.exists() else 0


configure_jax("jax_compilation_cache_dir", str(COMPILED))
configure_jax("jax_persistent_cache_min_compile_time_secs", 0.0)
configure_jax("jax_persistent_cache_min_entry_size_bytes", -1)
if is_at_hand("hypothesis"):
    from hypothesis import settings

    settings.register_profile("mfvpr", deadline=None, derandomize=True, max_examples=40)
    settings.load_profile("mfvpr")


class Compilations:
    """The number of programs that XLA compiled since the last `reset`."""

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
    """The counter, with nothing compiled yet."""
    jax.clear_caches()
    _compilations.reset()
    return _compilations


class Module(pytest.Module):
    """Skips as a whole where it imports a package that is not at hand."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        try:
            return super().collect()
        except self.CollectError as error:
            missing = isinstance(error.__cause__, ModuleNotFoundError) and str(error.__cause__.name).split(".")[0]
            if missing not in {*EXTRAS, *OF_A_CLONE}:
                raise
            pytest.skip(reason(missing), allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    return Module.from_parent(parent, path=module_path)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Count the skipped tests by reason."""
    reasons = Counter(
        report.longrepr[2].removeprefix("Skipped: ") for report in terminalreporter.stats.get("skipped", [])
    )
    for words, count in reasons.most_common():
        terminalreporter.write_line(f"{count:4} {words}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all cases but the first of a test that is marked `first_case` as slow."""
    seen = set()
    for item in items:
        test = item.nodeid.split("[")[0]
        if item.get_closest_marker("first_case") and test in seen:
            item.add_marker("slow")
        seen.add(test)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory_maps() -> None:
    """Drop compiled programs where they are too many."""
    if count_memory_maps() > MOST_MEMORY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory) -> Iterator[None]:
    """Nothing of the user's cache and weights is read or written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("MFVPR_WEIGHTS", str(tmp_path_factory.mktemp("none")))
        yield


def install_weights(root: Path, checkpoints: Iterable[tuple[str, dict[str, np.ndarray]]]) -> Path:
    """A folder of installed weights."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MFVPR_WEIGHTS", str(root))
        for name, tensors in checkpoints:
            entry, source = entry_of(name), root / f"{name}.source"
            source.write_text("not published")
            plan = plan_network(entry.builder())
            save(entry, convert(tensors, entry.table, plan.shapes), source, parameters=plan.parameters)
    return root


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Path:
    """Installed weights of every network but DINOv2 and its relatives, all random."""
    return install_weights(tmp_path_factory.mktemp("weights"), random_checkpoints.for_networks())


@pytest.fixture(scope="session")
def real_weights(tmp_path_factory) -> Path:
    """The same, but with the real weights of ALIKED and LightGlue."""
    skip_without(ALIKED, LIGHTGLUE)
    files = ALIKED / "aliked-n16.pth", ALIKED / "aliked-n32.pth", LIGHTGLUE
    real = {path.stem: read_checkpoint(path) for path in files}
    return install_weights(tmp_path_factory.mktemp("real"), (dict(random_checkpoints.for_networks()) | real).items())


@pytest.fixture(scope="session")
def small_street(tmp_path_factory) -> Path:
    """Ten frames of the synthetic street: database/, queries/, ground_truth.csv."""
    return streets_folder(tmp_path_factory.mktemp("cache"), num_frames=10, image_size=(320, 240))


@pytest.fixture(scope="session")
def tools(tmp_path_factory) -> Path:
    """Files of matches by hloc, kapture, COLMAP and vismatch."""
    skip_without("h5py")
    from tests.io.match_files import write_tool_files

    return write_tool_files(tmp_path_factory.mktemp("tools"))


@pytest.fixture(scope="session")
def dataset(small_street) -> Dataset:
    """The small street's ten queries, each with its database image."""
    return datasets.folder(small_street / "database", small_street / "queries", ground_truth="order")


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


@pytest.fixture(scope="module")
def golden(request) -> dict[str, np.ndarray]:
    """Numbers of public code (tests/golden) for the tests of `test_NAME.py` and `test_NAME_golden.py`."""
    return read_golden(request.path.stem.removeprefix("test_").removesuffix("_golden"))
