"""The README's numbers on real images, where those images are."""

import json

import pytest

from tests.needs import PHOTOGRAPHS, needs
from tests.programs import typed

pytestmark = [pytest.mark.slow, needs(PHOTOGRAPHS)]


@pytest.mark.parametrize(("name", "histogram_at_2"), [("grief_season", 0.50), ("corridor", 0.70)])
def test_histogram_recognizes_real_places(name, histogram_at_2, tmp_path, monkeypatch, capsys):
    root = PHOTOGRAPHS / name
    arguments = (f"dataset={name}", f"dataset.root={root}", "candidates=50", "figures=0", f"out={tmp_path}/out")
    code, _, stderr = typed(monkeypatch, capsys, "evaluate", *arguments)
    assert code == 0, stderr
    rows = json.loads((tmp_path / "out" / "results.json").read_text())
    recall = {row["system"]: row["recall_at"]["1"] for row in rows if row["tolerance"] == 2}
    assert recall["histogram"] >= histogram_at_2
    assert recall["histogram"] > recall["sum"] > recall["retrieval"] - 0.01
    assert recall["histogram"] > 2 * recall["count"]
