"""Files, programs and packages that some tests need beside a clone; without them, those tests skip for one reason."""

import re
import shutil
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from mfvpr.checkpoints import entry_of, is_installed, weights_folder

ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared"
PHOTOGRAPHS, ALIKED = SHARED / "data", SHARED / "weights" / "aliked"
LIGHTGLUE = SHARED / "weights" / "lightglue" / "aliked_lightglue.pth"
PROGRAMS = ("c++", "chromium", "cmake", "unshare")
WEIGHTS = weights_folder()  # of the user, whose weights other tests do not see
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


def use_weights(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Load the user's weights from now on; skip if those of a network are not installed."""
    monkeypatch.setenv("MFVPR_WEIGHTS", str(WEIGHTS))
    if not is_installed(entry_of(name)):
        pytest.skip(f"needs weights: mfvpr weights download {name}")
