"""matching=import in the programs, with files that hloc, COLMAP and vismatch wrote."""

import shutil

import numpy as np
import pytest

from mfvpr.datasets.streets import draw_streets

PAIRS = "queries/0000.png database/0000.png\nqueries/0000.png database/0001.png\n" \
        "queries/0001.png database/0000.png\nqueries/0001.png database/0001.png\n"  # fmt: skip


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The images that the tools matched."""
    root = tmp_path_factory.mktemp("images") / "street"
    draw_streets(root, seed=3, num_frames=2)
    (root / "pairs.txt").write_text(PAIRS)
    return root


@pytest.fixture
def settings(street, tools, tmp_path):
    """Settings of the images, with the matches of a tool."""

    def complete(*more, out="out"):
        completed = [setting.format(tools=tools) for setting in more]
        return ("dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
                "dataset.ground_truth=order", "retrieval=pairs", f"retrieval.queries={street}/pairs.txt",
                "candidates=2", "recall.tolerances=[0]", "recall.ks=[1]", "matching=import", "figures=0",
                f"cache={tmp_path}/cache", f"out={tmp_path}/{out}", *completed)  # fmt: skip

    return complete


@pytest.mark.first_case
@pytest.mark.parametrize("more", [
    ["matching.matches={tools}/hloc/matches.h5", "matching.features={tools}/hloc/feats.h5"],
    ["matching.matches={tools}/colmap.db", "matching.verified=true"],
    ["matching.matches={tools}/kapture"],
    ["matching.matches={tools}/vismatch", "matching.confidences=false"],
])  # fmt: skip
def test_an_evaluation_of_the_matches_of_a_tool(settings, more, tmp_path, succeed):
    """Names need no prefixes where folders have the names that the tool knew."""
    stdout, stderr = succeed("evaluate", *settings(*more, "scorer=count", "figures=1"))
    assert "2 candidates (pairs), imported matches;" in stdout
    assert "no matches of 1 of 4 pairs of the shortlist" in stderr
    assert "imported matches" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("folder", ["kapture", "kapture/reconstruction/matches/sift"])
def test_changed_keypoints_are_read_again(settings, tools, folder, tmp_path, succeed):
    shutil.copytree(tools / "kapture", tmp_path / "kapture")
    [file] = (tmp_path / "kapture").rglob("queries/0000.png.kpt")
    scores = []
    for out, factor in (("first", 1), ("moved", 0.8)):
        file.write_bytes((np.fromfile(file, np.float32) * factor).tobytes())
        succeed("evaluate", *settings(f"matching.matches={tmp_path}/{folder}", "scorer=histogram", out=out))
        scores.append((tmp_path / out / "predictions.csv").read_text())
    assert scores[0] != scores[1]


@pytest.mark.parametrize(("more", "words"), [
    (["matching.matches=missing.h5"], "missing.h5: "),
    ([], "matching.matches"),
    (["matching.matches={tools}/hloc/matches.h5"], "give hloc's feats*.h5"),
    (["matching.matches={tools}/kapture", "matching.image_size=[64,64]"], "image of 64"),
    (["matching.matches={tools}/kapture", "matching.query_prefix=other/"], "prefix"),
])  # fmt: skip
def test_wrong_settings_are_one_line(settings, refuse, more, words, tmp_path):
    assert words in refuse("evaluate", *settings(*more))
    assert not (tmp_path / "out").exists()
