"""The oldest versions that are tested, and tests that skip."""

import re

from tests.needs import ROOT, is_at_hand, needs, reason

REQUIREMENT = re.compile(r'"([\w-]+)>=([\d.]+)')


def test_the_oldest_versions_are_the_lower_bounds():
    lines = (ROOT / "tests" / "oldest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if "==" in line)
    bounds = dict(REQUIREMENT.findall((ROOT / "pyproject.toml").read_text()))
    del pinned["jaxlib"]  # follows from jax
    assert len(pinned) > 30
    assert [name for name in pinned if not f"{pinned[name]}.".startswith(f"{bounds[name]}.")] == []


def test_a_test_that_needs_what_is_not_at_hand_skips_with_its_name():
    assert needs("numpy").args == (False,)
    assert needs("numpy", "no_such_package").args == (True,)
    assert needs(ROOT / "no such file").kwargs["reason"].startswith("needs ../")
    assert reason("optuna") == "needs optuna, of the extra `sweep`"
    assert not is_at_hand("no_such_package")
