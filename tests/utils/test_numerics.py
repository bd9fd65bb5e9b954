"""The processors and the memory of the machine, and batches of one."""

from pathlib import Path

from mfvpr.utils.numerics import available_cpus, free_host_bytes


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
