"""Names and docstrings of the library, the programs and the tests that read at once."""

import ast
from pathlib import Path

import pytest

from tests.needs import needs

pytestmark = needs("experiments")

ROOT = Path(__file__).parent.parent
# Words that say nothing of the value. A few fields of public values still have them.
EMPTY_NAMES = {"found", "one", "kept", "told", "asked", "given", "made", "some", "others", "nothing", "who",
               "everything"}  # fmt: skip
BEGINNINGS = {"What", "Of", "How", "Where", "By", "That", "Those", "Whose", "Who"}
DEFINITIONS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def assigned_names(node):
    """Variables and arguments; a name that is only used, such as `hypothesis.given`, is somebody else's."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        return [node.id]
    return [node.arg] if isinstance(node, ast.arg) else []


def modules(folder):
    return [(path, ast.parse(path.read_text())) for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("folder", ["mfvpr", "experiments", "tests"])
def test_variables_and_arguments_say_what_they_hold(folder):
    empty = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
        for path, tree in modules(folder)
        for node in ast.walk(tree)
        for name in assigned_names(node)
        if name in EMPTY_NAMES
    ]
    assert empty == []


@pytest.mark.parametrize("folder", ["mfvpr", "experiments", "tests"])
def test_docstrings_begin_with_a_noun_or_a_verb(folder):
    docstrings = {
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}": ast.get_docstring(node)
        for path, tree in modules(folder)
        for node in ast.walk(tree)
        if isinstance(node, DEFINITIONS)
    }
    assert len(docstrings) > 100
    assert [place for place, text in docstrings.items() if text and text.split()[0].strip(",.:;") in BEGINNINGS] == []
