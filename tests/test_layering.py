"""Imports run downwards only, and each foreign library stays in its room (the ground plan of the README)."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# What each room may import of mfvpr. Rooms not named stand on everything.
ALLOWED = {
    "errors": set(),
    "declaration": {"errors"},
    "numerics": {"errors"},
    "types": set(),
    "weighting": {"errors", "numerics", "types"},
    "learned_weight": {"errors", "numerics", "types", "weighting"},
    "weight_files": {"data", "errors", "learned_weight"},
    "named_weights": {"weight_files", "weighting"},
    "neighbors": {"types"},
    "ragged": set(),
    "progress": set(),
    "threads": set(),
    "matching": {"errors", "neighbors", "numerics", "ragged", "types"},
    "matchers": {"matching", "numerics", "types"},
    "lightglue": {"errors", "fingerprints", "matching", "models", "neighbors", "types"},
    "soft_matching": {"matching", "numerics", "types"},
    "match_sets": {"errors", "numerics", "ragged", "threads", "types"},
    "sources": {"errors", "numerics", "ragged", "types"},
    "behavior": set(),
    "fingerprints": {"behavior"},
    "shards": {"errors"},
    "stores": {"data", "errors", "fingerprints", "match_sets", "shards", "stores", "threads", "types"},
    "pair_matching": {"match_sets", "matchers", "numerics", "ragged", "sources", "threads", "types"},
    "scoring": {"declaration", "errors", "named_weights", "numerics", "types", "weighting", "scoring"},
    "whitening": {"errors"},
    "retrieval": {"errors", "evaluation", "numerics", "ragged", "types", "whitening"},
    "reranking": {"errors", "numerics", "types", "scoring"},
    "parameter_grids": {"matching", "numerics", "types", "scoring", "weighting", "reranking"},
    "sweeping": {
        "data",
        "declaration",
        "errors",
        "evaluation",
        "fingerprints",
        "match_sets",
        "numerics",
        "parameter_grids",
        "progress",
        "reranking",
        "scoring",
        "sweeping",
        "threads",
        "types",
        "weighting",
    },
    "learning": {
        "data",
        "declaration",
        "errors",
        "evaluation",
        "fingerprints",
        "learned_weight",
        "learning",
        "match_sets",
        "matching",
        "numerics",
        "ragged",
        "reranking",
        "scoring",
        "sweeping",
        "types",
        "weighting",
        "progress",
    },
    "evaluation": {"errors", "fingerprints", "types", "evaluation"},
    "foreign": {"errors", "foreign"},
    "data": {"errors", "evaluation", "foreign", "numerics", "threads", "types", "data"},
    "models": {"errors", "numerics", "types", "models"},
    "weights": {"errors", "data", "foreign", "models", "weights"},
    "features": {
        "errors",
        "types",
        "numerics",
        "data",
        "models",
        "ragged",
        "sources",
        "whitening",
        "features",
        "fingerprints",
    },
    "extraction": {"errors", "types", "numerics", "data", "features", "progress", "sources", "threads"},
    "exchange": {"errors", "types", "data", "exchange"},
    "cohort": {"data", "errors", "numerics", "pipeline", "progress", "ranked", "scoring", "types"},
    "checks": {
        "data",
        "declaration",
        "errors",
        "features",
        "filters",
        "lightglue",
        "matchers",
        "matching",
        "rankings",
        "reranking",
        "ranked",
        "results",
        "scoring",
        "sources",
        "types",
    },
    "testing": {"errors", "numerics", "reranking", "scoring", "types"},
    "confidence": {"data", "errors", "ranked", "results"},
    "maps": {
        "confidence",
        "data",
        "errors",
        "extraction",
        "features",
        "fingerprints",
        "maps",
        "matchers",
        "numerics",
        "pipeline",
        "progress",
        "reranking",
        "ranked",
        "results",
        "scoring",
        "sources",
        "stores",
        "threads",
        "types",
    },
    "distributed": {"errors", "evaluation", "numerics", "reranking", "retrieval", "scoring", "types"},
    "report": {
        "numerics",
        "archive",
        "confidence",
        "ranked",
        "results",
        "data",
        "errors",
        "evaluation",
        "evaluations",
        "features",
        "fingerprints",
        "learned_weight",
        "learning",
        "maps",
        "pipeline",
        "report",
        "scoring",
        "sweeping",
        "types",
        "weight_files",
    },
}
HOMES = {
    "cv2": {"data", "features", "scoring"},
    "PIL": {"data", "report"},
    "matplotlib": {"report"},
    "plotly": {"report"},
    "jinja2": {"report"},
    "markupsafe": {"report"},
    "hydra": set(),
    "omegaconf": set(),
    "torch": set(),
    "flax": {"models", "weights", "features"},
    "safetensors": {"weights"},
    "tqdm": set(),
    "optax": {"learning"},
    "orbax": {"learning"},
    "h5py": {"exchange"},
}
MODULES = sorted((ROOT / "mfvpr").rglob("*.py"))


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ([f"mfvpr.{alias.name}" for alias in node.names] if node.module == "mfvpr" else [node.module])


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_imports_run_downwards(path):
    room = path.relative_to(ROOT / "mfvpr").parts[0].removesuffix(".py")
    for name in imports(path):
        top, _, rest = name.partition(".")
        assert room in HOMES.get(top, {room}), f"{name} does not belong in {room}"
        if top == "mfvpr" and room in ALLOWED:
            assert rest.partition(".")[0] in ALLOWED[room], f"{room} must not import {name}"


def test_there_is_something_to_check():
    assert len(MODULES) > 40
