"""Compiled programs stay on disk between processes, for one processor and version; processors and memory."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from mfvpr.utils import compiled_programs, numerics
from mfvpr.utils.numerics import available_cpus, free_host_bytes
from tests.programs import ROOT

PROGRAM = """
import jax, jax.numpy as jnp
jnp.zeros(3).sum()  # a user's own program comes first
from mfvpr.utils.compiled_programs import keep_compiled_programs
events = []
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
keep_compiled_programs()
print(jax.jit(lambda x: jnp.cumsum(x) @ x)(jnp.arange(4.0)), events.count('/jax/compilation_cache/cache_hits') > 0)
print(jax.config.jax_compilation_cache_dir)
"""


def run(cache, **variables):
    """The printed result, whether programs were read, and JAX's folder, of a new process."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore:Error", "-c", PROGRAM],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        env=environment | {"MFVPR_CACHE": str(cache), "JAX_PLATFORMS": "cpu"} | variables,
    )
    return done.stdout.split()


def test_the_next_process_reads_what_one_has_compiled(tmp_path):
    result, is_read, folder = run(tmp_path)
    assert (result, is_read) == ("25.0", "False")
    assert run(tmp_path) == ["25.0", "True", folder]
    files = [path for path in (tmp_path / "compiled").rglob("*-cache") if str(path).startswith(folder)]
    assert files
    for path in files:
        path.write_bytes(path.read_bytes()[:100])  # as a process that was killed leaves them
    assert run(tmp_path) == ["25.0", "False", folder]


def test_nothing_is_written_if_the_user_says_so(tmp_path):
    assert run(tmp_path, MFVPR_COMPILED="false")[1:] == ["False", "None"]
    assert run(tmp_path, JAX_ENABLE_COMPILATION_CACHE="false")[1:] == ["False", "None"]
    own = str(tmp_path / "own")
    assert run(tmp_path, JAX_COMPILATION_CACHE_DIR=own)[1:] == ["False", own]
    assert not (tmp_path / "compiled").exists()
    (tmp_path / "file").touch()  # below which no folder can be made
    assert run(tmp_path / "file") == ["25.0", "False", "None"]


@pytest.fixture
def keep(monkeypatch, tmp_path):
    """Warnings of `keep_compiled_programs` where JAX has no folder yet, and JAX's folder."""
    names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    before = {name: jax.config.values[name] for name in names}
    monkeypatch.setenv("MFVPR_COMPILED", "true")
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    warnings = list[str]()

    def call():
        jax.config.update("jax_compilation_cache_dir", None)
        compiled_programs.keep_compiled_programs(warnings.append)
        return warnings, jax.config.jax_compilation_cache_dir

    yield call
    for name in names:
        jax.config.update(name, before[name])
    compilation_cache.reset_cache()


def test_without_a_home_nothing_is_kept(keep, monkeypatch, tmp_path):
    monkeypatch.setenv("MFVPR_CACHE", "")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as of an unknown user without HOME
    assert keep() == ([], None)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("case", ["owner", "group", "others", "above"])
def test_machine_code_of_others_is_not_read(keep, monkeypatch, tmp_path, case):
    folder = compiled_programs._folder()
    folder.mkdir(0o755, parents=True)
    if case == "owner" and os.getuid():
        monkeypatch.setattr(os, "getuid", lambda: 54321)
    elif case == "owner":
        os.chown(folder, 54321, -1)
    else:
        path, mode = {"group": (folder, 0o775), "others": (folder, 0o1757), "above": (tmp_path, 0o757)}[case]
        path.chmod(mode)
    for _ in range(2):  # it warns once
        (warning,), used = keep()
        assert "expected a folder that is yours" in warning
        assert used is None


def test_ones_own_folder_below_tmp_is_used(keep, tmp_path):
    tmp_path.chmod(0o1777)
    assert keep() == ([], str(compiled_programs._folder()))


def test_processors_and_versions_have_folders_of_their_own(monkeypatch, tmp_path):
    cpuinfo, folders = tmp_path / "cpuinfo", []
    monkeypatch.setattr(numerics, "_CPUINFO", cpuinfo)
    for flags in ("fpu avx2", "fpu avx2 avx512f", "fpu avx2"):
        cpuinfo.write_text(f"processor: 0\nmodel : 85\ncpu MHz : {len(folders)}\nflags : {flags}\n" * 2)
        folders.append(compiled_programs._folder())
    monkeypatch.setattr(compiled_programs, "versions", lambda: dict.fromkeys(["mfvpr", "jax", "jaxlib"], "9.9"))
    folders.append(compiled_programs._folder())
    cpuinfo.unlink()  # not on Linux
    folders.append(compiled_programs._folder())
    assert folders[0] == folders[2]
    assert len({*folders}) == 4


def test_any_system_has_free_memory(monkeypatch):
    assert free_host_bytes() > 10**7
    monkeypatch.setattr(Path, "read_text", lambda _: "something else")
    assert free_host_bytes() > 10**7


def test_processors_are_those_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3, 5, 8}, raising=False)
    assert available_cpus() == 3
    monkeypatch.delattr("os.sched_getaffinity")
    monkeypatch.setattr("os.cpu_count", lambda: None)
    assert available_cpus() == 1
