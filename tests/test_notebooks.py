"""The notebooks are run, not believed; their stored output is that of their code."""

import asyncio
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from mfvpr.datasets.streets import streets_folder
from notebooks.build import RUN_OF, code_hash

FOLDER = Path(__file__).parent.parent / "notebooks"
PATHS = sorted(FOLDER.glob("*.ipynb"))


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """All notebooks, or what stopped them, after their execution side by side in an empty folder, and that folder."""
    streets_folder(Path(os.environ["MFVPR_CACHE"]), num_frames=40)  # or each of them would draw it at the same time
    folder = tmp_path_factory.mktemp("notebooks")
    notebooks = [nbformat.read(path, as_version=4) for path in PATHS]

    async def execute():
        clients = (NotebookClient(book, timeout=900, resources={"metadata": {"path": folder}}) for book in notebooks)
        return await asyncio.gather(*(client.async_execute() for client in clients), return_exceptions=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IPYTHONDIR", str(tmp_path_factory.mktemp("ipython")))  # nothing of the user's is read or written
        patch.delenv("MPLBACKEND", raising=False)  # pictures inline, wherever the tests run
        results = asyncio.run(execute())
    return dict(zip(PATHS, results, strict=True)), folder


def test_there_are_eight():
    assert [path.name[0] for path in PATHS] == [*"12345678"]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_the_output_is_that_of_the_code(path):
    notebook = nbformat.read(path, as_version=nbformat.NO_CONVERT)
    nbformat.validate(notebook)
    assert set(notebook.metadata) == {"kernelspec", RUN_OF}
    assert notebook.metadata.kernelspec.name == "python3"
    assert notebook.metadata[RUN_OF] == code_hash(notebook), "run `python notebooks/build.py`"
    for cell in notebook.cells:
        assert not cell.metadata
        assert re.fullmatch(r"[a-z]+(-[a-z]+)*", cell.id)  # by hand: random ones would change with every save
    assert [cell.execution_count for cell in code(notebook)] == [*range(1, len(code(notebook)) + 1)]
    pictures = [output.data["image/png"] for cell in code(notebook) for output in cell.outputs if "data" in output]
    assert len(pictures) >= 3
    assert max(map(len, pictures)) * 3 / 4 < 100_000  # bytes
    assert not re.search(r"/(work|tmp|root|home)/", path.read_text())


@pytest.mark.slow
@pytest.mark.timeout(1800)  # all of them run at once, before the first
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_they_run_and_show_pictures(path, executed):
    result = executed[0][path]
    assert not isinstance(result, BaseException), result
    cells = code(result)
    assert all(cell.execution_count for cell in cells)
    outputs = [output for cell in cells for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_they_leave_no_files(executed):
    assert not list(executed[1].iterdir())
    assert {path.suffix for path in FOLDER.iterdir() if path.is_file()} == {".ipynb", ".py"}
