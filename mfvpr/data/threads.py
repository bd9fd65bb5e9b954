"""Threads of the host."""

import os


def available_cpus() -> int:
    """Processors that this process may run on: fewer than the machine has where a scheduler or container says so."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
