"""Packages import only packages above them, and each library of others stays where it belongs."""

import ast
import importlib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "mfvpr"
# Packages and modules at the root, each with all that it imports of those above it.
PERMISSIONS = {
    "utils": set(),
    "types": {"utils"},
    "io": {"types", "utils"},
    "networks": {"types", "utils"},
    "scoring": {"types", "utils"},
    "checkpoints": {"io", "networks", "utils"},
    "datasets": {"io", "utils"},
    "features": {"datasets", "networks", "types", "utils"},
    "matching": {"datasets", "features", "io", "networks", "types", "utils"},
    "storage": {"datasets", "features", "matching", "types", "utils"},
    "retrieval": {"datasets", "features", "io", "storage", "types", "utils"},
    "reranking": {"datasets", "matching", "scoring", "types", "utils"},
    "evaluation": {
        "datasets", "features", "matching", "reranking", "retrieval", "scoring", "storage", "types", "utils",
    },
    "testing": {"reranking", "scoring", "types", "utils"},
    "systems": {
        "checkpoints", "datasets", "evaluation", "features", "matching", "networks", "reranking", "retrieval",
        "scoring", "utils",
    },
    "localization": {
        "datasets", "evaluation", "features", "matching", "reranking", "retrieval", "scoring", "storage", "systems",
        "types", "utils",
    },
    "deployment": {"evaluation", "matching", "reranking", "scoring", "types", "utils"},
    "tuning": {"datasets", "evaluation", "matching", "reranking", "scoring", "types", "utils"},
    "report": {
        "datasets", "evaluation", "features", "io", "localization", "reranking", "scoring", "storage", "tuning",
        "types", "utils",
    },
    "cli": {
        "checkpoints", "datasets", "evaluation", "features", "io", "localization", "matching", "report", "reranking",
        "retrieval", "scoring", "storage", "systems", "tuning", "types", "utils",
    },
}  # fmt: skip
LIBRARIES = {
    "cv2": {"datasets", "features", "scoring"},
    "PIL": {"datasets", "report"},
    "flax": {"networks", "checkpoints", "features"},
    "safetensors": {"checkpoints"},
    "jax2onnx": {"deployment"},
    "onnxruntime": {"deployment"},
    "optax": {"tuning"},
    "orbax": {"tuning"},
    "filelock": {"utils"},
    "dask": {"utils"},
    "distributed": {"utils"},
    "h5py": {"io"},
    "matplotlib": {"report"},
    "plotly": {"report"},
    "jinja2": {"report"},
    "markupsafe": {"report"},
    "hydra": {"cli"},
    "omegaconf": {"cli"},
    "torch": set(),
}


def imported_modules(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "mfvpr":
            yield from (f"mfvpr.{alias.name}" for alias in node.names if alias.name != "__version__")
        elif isinstance(node, ast.ImportFrom):
            yield node.module


@cache
def imports_of(package):
    """All modules that a package, or a module at the root, imports from elsewhere."""
    paths = (ROOT / package).rglob("*.py") if (ROOT / package).is_dir() else [ROOT / f"{package}.py"]
    return {name for path in paths for name in imported_modules(path)}


def test_the_root_holds_the_packages_alone():
    entries = {
        path.stem
        for path in ROOT.iterdir()
        if path.name not in ("__init__.py", "__init__.pyi", "__pycache__", "py.typed")
    }
    assert entries == set(PERMISSIONS)


@pytest.mark.parametrize("package", PERMISSIONS)
def test_a_package_imports_what_is_permitted_of_those_above_it_and_all_of_it(package):
    modules = {name.split(".")[1] for name in imports_of(package) if name.startswith("mfvpr.")}
    assert modules - {package} == PERMISSIONS[package]
    packages = list(PERMISSIONS)
    assert PERMISSIONS[package] <= set(packages[: packages.index(package)])


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_library_is_used_where_it_belongs_and_in_all_these_places(library):
    places = {package for package in PERMISSIONS if library in {name.split(".")[0] for name in imports_of(package)}}
    assert places == LIBRARIES[library]


@pytest.mark.parametrize("package", [package for package in PERMISSIONS if (ROOT / package).is_dir()])
def test_a_package_exports_what_it_names(package):
    module = importlib.import_module(f"mfvpr.{package}")
    assert all(hasattr(module, name) for name in module.__all__)
    assert len(module.__all__) > 1
