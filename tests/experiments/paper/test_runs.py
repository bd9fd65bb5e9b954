"""The folder of the paper's evaluation: nothing of others is removed from it."""

import pytest

from experiments.paper.runs import lock_output
from mfvpr.utils.errors import InputError


@pytest.mark.parametrize("entries", [["figures"], ["runs", "figures", "thesis.tex"]])
def test_a_folder_with_files_of_others_is_refused(tmp_path, entries):
    for name in entries:
        (tmp_path / name).mkdir()
    with (
        pytest.raises(InputError, match="expected a new or empty folder, or one of this program"),
        lock_output(tmp_path),
    ):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {*entries}


@pytest.mark.parametrize("earlier", [[], ["runs"], ["runs", "tables", "figures", "report.html", ".DS_Store"]])
def test_a_new_folder_and_an_earlier_output_are_not(tmp_path, earlier):
    for name in earlier:
        (tmp_path / name).mkdir()
    with lock_output(tmp_path):
        pass
