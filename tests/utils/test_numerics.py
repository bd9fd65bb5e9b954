"""The processors and the memory of the machine, and batches of one."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr.utils.numerics import available_cpus, free_host_bytes, over_batch


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


@pytest.mark.parametrize("number", [1, 3])
def test_a_batch_has_the_results_of_vmap(number):
    def function(points, scales):
        return {"shifted": points + scales["x"], "sum": jnp.sum(points) * scales["y"]}

    rng = np.random.default_rng(0)
    points, scales = rng.normal(size=(number, 4)), {"x": rng.normal(size=(number, 4)), "y": rng.normal(size=number)}
    expected, got = jax.vmap(function)(points, scales), over_batch(function)(points, scales)
    assert jax.tree.map(lambda a, b: np.array_equal(a, b), got, expected) == {"shifted": True, "sum": True}
