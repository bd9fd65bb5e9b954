"""Files, programs and packages that some tests need beside a clone; without them, those tests skip for one reason."""

import re
import shutil
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared"
PHOTOGRAPHS, ALIKED = SHARED / "data", SHARED / "weights" / "aliked"
LIGHTGLUE = SHARED / "weights" / "lightglue" / "aliked_lightglue.pth"
PROGRAMS = ("c++", "chromium", "cmake", "unshare")
OF_A_CLONE = ("experiments", "notebooks")  # packages that the wheel does not hold

_lists = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
# The packages of the optional dependencies, and the extra of each.
EXTRAS = {re.split(r"[^\w-]", line)[0].replace("-", "_"): extra for extra in _lists for line in _lists[extra]}


def is_at_hand(name: str | Path) -> bool:
    """Whether this machine has a file, a program, or else a package."""
    if isinstance(name, Path):
        return name.exists()
    return shutil.which(name) is not None if name in PROGRAMS else find_spec(name) is not None


def reason(name: str | Path) -> str:
    """Why a test skips."""
    if isinstance(name, Path):
        return f"needs ../{name.relative_to(ROOT.parent)}"
    if name in OF_A_CLONE:
        return "needs a clone"
    return f"needs {name}" + (f", of the extra `{EXTRAS[name]}`" if name in EXTRAS else "")


def needs(*names: str | Path) -> pytest.MarkDecorator:
    """Skip a test, or a whole module, where one of these is not at hand."""
    missing = [name for name in names if not is_at_hand(name)]
    return pytest.mark.skipif(bool(missing), reason=reason(missing[0]) if missing else "")


def skip_without(*names: str | Path) -> None:
    """Skip from within a fixture or a test."""
    for name in names:
        if not is_at_hand(name):
            pytest.skip(reason(name))
