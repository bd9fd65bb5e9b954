"""The core imports no other package but small helpers, and packages do not import each other in a circle; versions."""

import ast
import graphlib
import re
import sys
from pathlib import Path

import mfvpr
from tests.needs import ROOT as CLONE

ROOT = Path(mfvpr.__file__).parent


def imported_modules(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "mfvpr":
            yield from (f"mfvpr.{alias.name}" for alias in node.names if alias.name != "__version__")
        elif isinstance(node, ast.ImportFrom):
            yield node.module


def imported_packages(package):
    modules = {name for path in (ROOT / package).rglob("*.py") for name in imported_modules(path)}
    return {name.split(".")[1] for name in modules if name.startswith("mfvpr.")} - {package}


def test_core_imports_helpers_of_arrays_and_errors_alone():
    modules = {name for path in (ROOT / "core").rglob("*.py") for name in imported_modules(path)}
    ours = {name for name in modules if name.startswith("mfvpr.") and not name.startswith("mfvpr.core.")}
    assert ours == {"mfvpr.utils.errors", "mfvpr.utils.fields", "mfvpr.utils.numerics"}
    others = {name.split(".")[0] for name in modules - ours} - {"mfvpr"}
    assert others - sys.stdlib_module_names == {"jax", "jaxtyping", "lazy_loader", "numpy"}


def test_packages_do_not_import_each_other_in_a_circle():
    packages = [path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()]
    graphlib.TopologicalSorter({package: imported_packages(package) for package in packages}).prepare()


def test_the_oldest_versions_are_the_lower_bounds():
    lines = (CLONE / "tests" / "oldest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if "==" in line)
    bounds = dict(re.findall(r'"([\w-]+)>=([\d.]+)', (CLONE / "pyproject.toml").read_text()))
    del pinned["jaxlib"]  # follows from jax
    assert len(pinned) > 30
    assert [name for name in pinned if not f"{pinned[name]}.".startswith(f"{bounds[name]}.")] == []
