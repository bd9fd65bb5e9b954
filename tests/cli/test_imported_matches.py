"""matching=import in the programs, with files that hloc, COLMAP and vismatch wrote."""

import json
import shutil

import numpy as np
import pytest

from mfvpr.datasets.streets import draw_streets
from tests.programs import typed

PAIRS = "queries/0000.png database/0000.png\nqueries/0000.png database/0001.png\n" \
        "queries/0001.png database/0000.png\nqueries/0001.png database/0001.png\n"  # fmt: skip


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The images that the tools matched."""
    root = tmp_path_factory.mktemp("images") / "street"
    draw_streets(root, seed=3, num_frames=2)
    (root / "pairs.txt").write_text(PAIRS)
    return root


def settings(street, *more):
    return ("dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
            "dataset.ground_truth=order", "retrieval=pairs", f"retrieval.queries={street}/pairs.txt",
            "candidates=2", "recall.tolerances=[0]", "recall.ks=[1]", "matching=import", *more)  # fmt: skip


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("tool", "more"),
    [
        ("hloc/matches.h5", ["matching.features={tools}/hloc/feats.h5"]),
        ("colmap.db", ["matching.verified=true"]),
        ("kapture", []),
        ("vismatch", ["matching.confidences=false"]),
    ],
)
def test_an_evaluation_of_the_matches_of_a_tool(street, tools, tool, more, tmp_path, monkeypatch, capsys):
    """Names need no prefixes where folders have the names that the tool knew."""
    more = [setting.format(tools=tools) for setting in more]
    typed_here = settings(street, f"matching.matches={tools}/{tool}", *more, "scorer=count", "figures=1",
                          "cache=null", f"out={tmp_path}/out")  # fmt: skip
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *typed_here)
    assert code == 0, stderr
    assert "2 candidates (pairs), imported matches;" in stdout
    if tool != "colmap.db":
        assert "no matches of 1 of 4 pairs of the shortlist" in stderr
    counts = json.loads((tmp_path / "out" / "results.json").read_text())
    assert counts
    assert "imported matches" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("folder", ["kapture", "kapture/reconstruction/matches/sift", "link"])
def test_changed_keypoints_are_read_again(street, tools, folder, tmp_path, monkeypatch, capsys):
    shutil.copytree(tools / "kapture", tmp_path / "kapture")
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "reconstruction").symlink_to(tmp_path / "kapture" / "reconstruction")
    [file] = (tmp_path / "kapture").rglob("queries/0000.png.kpt")
    scores = []
    for change in (0, 20):
        points = np.fromfile(file, np.float32) * (1 - change / 100)
        file.write_bytes(points.tobytes())
        typed_here = settings(street, f"matching.matches={tmp_path}/{folder}", "scorer=histogram", "figures=0",
                              f"cache={tmp_path}/cache", f"out={tmp_path}/out{change}")  # fmt: skip
        code, _, stderr = typed(monkeypatch, capsys, "evaluate", *typed_here)
        assert code == 0, stderr
        scores.append((tmp_path / f"out{change}" / "predictions.csv").read_text())
    assert scores[0] != scores[1]


def test_a_sweep_of_imported_matches(street, tools, tmp_path, monkeypatch, capsys):
    typed_here = settings(street, f"matching.matches={tools}/kapture", "scorer=histogram", "grid.sigma=[10,20]",
                          f"cache={tmp_path}/cache", f"out={tmp_path}/out")  # fmt: skip
    code, stdout, stderr = typed(monkeypatch, capsys, "sweep", *typed_here)
    assert code == 0, stderr
    assert "score, imported matches; recall in %" in stdout


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["matching.matches=missing.h5"], "missing.h5: "),
        ([], "matching.matches"),
        (["matching.matches={tools}/hloc/matches.h5"], "give hloc's feats*.h5"),
        (["matching.matches={tools}/hloc/matches.h5", "matching.features={tools}/colmap.db"], "colmap.db: expected"),
        (["matching.matches={tools}/kapture", "matching.image_size=[64,64]"], "image of 64"),
        (["matching.matches={tools}/kapture", "matching.query_prefix=other/"], "prefix"),
        (["matching.matches={tools}/kapture", "matching.verified=true"], "verified=True"),
        (["matching.matches={tools}/kapture", "scorer=histogram", "scorer.weight=ratio"], "with_ratio=True"),
        (["matching.matches={tools}"], "expected a file .npz or .torch"),
        (["matching.matches={tools}/kapture", "matching.max_distance=1"], "max_distance"),
    ],
)
def test_wrong_settings_are_one_line(street, tools, more, words, tmp_path, monkeypatch, capsys):
    more = [setting.format(tools=tools) for setting in more]
    typed_here = settings(street, *more, "cache=null", f"out={tmp_path}/out")
    code, _, stderr = typed(monkeypatch, capsys, "evaluate", *typed_here)
    assert code == 2
    assert words in stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()
