"""The README's numbers on real images, and a drive off the map, where those images are."""

import json
from dataclasses import replace
from itertools import islice

import pytest

import mfvpr
from mfvpr.datasets import image_folder
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


GRIEF, CORRIDOR = ("grief_season/database", "grief_season/queries"), ("corridor/ref", "corridor/query")


@pytest.mark.parametrize(("here", "elsewhere"), [(GRIEF, CORRIDOR), (CORRIDOR, GRIEF)], ids=["grief", "corridor"])
def test_a_route_leaves_the_map_for_another_place_and_returns(here, elsewhere, real_weights, tmp_path, monkeypatch):
    monkeypatch.setenv("MFVPR_WEIGHTS", str(real_weights))
    images, drive, other = (image_folder(PHOTOGRAPHS / folder) for folder in (*here, elsewhere[1]))
    images = replace(images, names=images.names[:46])
    known = mfvpr.Map.create(tmp_path / "map", images, mfvpr.load_system("steering", features="aliked"))
    route = mfvpr.Route()

    def follow(paths):
        return [known.localize(path, route=route) for path in paths]

    assert abs(follow(drive.paths[:8])[-1].located.row - 7) <= 2
    refused = (path for path in other.paths if known.localize(path).place is None)
    off = follow(islice(refused, 10))[-1]
    assert (off.reason, off.place, off.located.row) == ("off the map", None, None)
    assert off.located.off >= 0.9
    assert off.located.p < 0.1
    back = follow(drive.paths[40:45])[-1]
    assert abs(back.located.row - 44) <= 2
    assert back.located.p > 0.5
