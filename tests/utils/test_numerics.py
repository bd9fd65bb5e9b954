"""The processors and the memory of the machine."""

from pathlib import Path

from mfvpr.utils.numerics import free_host_bytes


def test_free_memory_is_told_by_any_system(monkeypatch):
    assert free_host_bytes() > 10**7
    monkeypatch.setattr(Path, "read_text", lambda _: "something else")
    assert free_host_bytes() > 10**7
