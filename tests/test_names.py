"""Names and docstrings of the library and of the programs that read at once."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# Words that say nothing of the value. A few fields of public values still have them.
EMPTY_NAMES = {"found", "one", "kept", "told", "asked", "given", "made", "some", "others", "nothing", "who",
               "everything"}  # fmt: skip
BEGINNINGS = {"What", "Of", "How", "Where", "By", "That", "Those", "Whose", "Who"}
DEFINITIONS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def modules(folder):
    return [(path, ast.parse(path.read_text())) for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("folder", ["mfvpr", "experiments"])
def test_variables_and_arguments_say_what_they_hold(folder):
    empty = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
        for path, tree in modules(folder)
        for node in ast.walk(tree)
        for name in ([node.id] if isinstance(node, ast.Name) else [node.arg] if isinstance(node, ast.arg) else [])
        if name in EMPTY_NAMES
    ]
    assert empty == []


@pytest.mark.parametrize("folder", ["mfvpr", "experiments"])
def test_docstrings_begin_with_a_noun_or_a_verb(folder):
    docstrings = {
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}": ast.get_docstring(node)
        for path, tree in modules(folder)
        for node in ast.walk(tree)
        if isinstance(node, DEFINITIONS)
    }
    assert len(docstrings) > 300
    assert [place for place, text in docstrings.items() if text and text.split()[0].strip(",.:;") in BEGINNINGS] == []
