"""Rows, settings and data sets of the evaluations, and the tables of their numbers."""

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.paper import systems
from experiments.paper.pages import mean_recalls
from experiments.paper.runs import input_fingerprints, lock_output, settings_of
from experiments.paper.systems import DRAWN, ROWS, Place, missing_weights, places
from experiments.paper.tables import OVERALL, Evaluations, RowResult, beside, paper_tables, printed_tables, row_result
from mfvpr.cli.schema import Paper
from mfvpr.datasets import Dataset, FrameTruth, ImageFolder, QuerySequence
from mfvpr.utils.errors import InputError

pytestmark = pytest.mark.thorough

SETTINGS = Paper(out="out", cache=None)
RUNS = list(dict.fromkeys(row.run for row in ROWS))


def compose(run, place=DRAWN, root=None):
    chosen = (f"dataset={place}", *([] if root is None else [f"dataset.root={root}"]))
    return settings_of(run, Place(place, chosen), SETTINGS)


def test_every_printed_row_has_an_evaluation():
    known = {row.name for row in ROWS}
    for table in ("recall", "sequences", "sizes", "seconds", "pitts30k"):
        assert {*printed_tables()[table]} <= known, table
    assert len(known) == len(ROWS) == len({row.title for row in ROWS})


@pytest.mark.parametrize("run", RUNS)
def test_every_evaluation_has_settings_of_the_paper(run):
    settings = compose(run)
    candidates = {"patch_netvlad": 100, "sift_10": 10, "aliked_10": 10, "mix_hist_10": 10, "mix_hist_comb_10": 10}
    expected = next((number for name, number in candidates.items() if run.startswith(name)), 50)
    assert settings.candidates == expected
    sizes = {"mix": [320, 320], "ssm": [336, 336], "selavpr": [224, 224], "patch_netvlad": [640, 480]}
    for name, size in sizes.items():
        if run.startswith(name):
            assert settings.features["image_size"] == size
    assert settings.final == ("combined" if "comb" in run else "score")


def test_settings_depend_on_the_data_set(tmp_path):
    assert compose("patch_netvlad_speed", "robotcar_seasons", tmp_path).features["image_size"] == [480, 480]
    assert compose("sift_50").recall.tolerances == [1, 2, 5]
    assert compose("sift_50", "nordland_27592", tmp_path).recall.tolerances == [10]


def test_data_sets_are_found_by_their_names(tmp_path):
    (tmp_path / "Gardens_point_RAS2020").mkdir()
    (tmp_path / "corridor").mkdir()
    available, left_out = places(str(tmp_path), None)
    assert [place.name for place in available] == [DRAWN, "corridor", "gardens_point"]
    assert f"dataset.root='{tmp_path}/Gardens_point_RAS2020'" in available[2].settings
    assert len(left_out) == 12
    assert left_out[0] == f"grief_season: needs {tmp_path}/grief_season with database and queries"
    assert [line for line in left_out if line.startswith("msls_val: needs ") and "https://" in line]
    available, left_out = places(None, ["corridor", DRAWN])
    assert ([place.name for place in available], len(left_out)) == ([DRAWN], 1)
    for arguments, words in (((None, ["x"]), "datasets"), ((str(tmp_path / "no"), None), "expected a folder")):
        with pytest.raises(InputError, match=words):
            places(*arguments)


def test_folders_with_positions_in_image_names_are_data_sets(tmp_path):
    for folder in ("pitts30k/images/test", "other", "no positions"):
        for side in ("database", "queries"):
            (inside := tmp_path / folder / side).mkdir(parents=True)
            (inside / ("1.jpg" if folder == "no positions" else "@1@2@.jpg")).touch()
    available, left_out = places(str(tmp_path), None)
    assert [place.name for place in available] == [DRAWN, "other", "pitts30k"]
    settings = " ".join(available[2].settings).replace("'", "")
    assert f"dataset.database={tmp_path}/pitts30k/images/test/database" in settings
    assert [line for line in left_out if line.startswith("pitts30k_test: needs ")]


def test_weights_that_are_missing_are_named(monkeypatch):
    monkeypatch.setattr(systems, "is_installed", lambda entry: False)
    assert [entry.name for entry in missing_weights(compose("mix_hist_50"))] == ["d2_tf", "mixvpr_4096"]
    assert [entry.name for entry in missing_weights(compose("ssm_vpr"))] == ["vgg16_places365"]
    assert missing_weights(compose("sift_50")) == []


def test_a_run_is_known_by_what_decides_its_numbers(tmp_path):
    def inputs(run="sift_50", root="a", queries="b", rows=((0,), (1,), (2,)), **changes):
        folder, settings = ImageFolder(Path(), ("0", "1", "2")), compose(run, "corridor", tmp_path / root)
        dataset = Dataset("corridor", folder, (QuerySequence("one", folder, FrameTruth(rows, 3)),))
        images = {"database": "a", "queries": queries}
        return input_fingerprints(replace(settings, **changes), images, dataset.positives_fingerprint([1]))

    before = inputs()
    assert inputs(root="b", out="elsewhere") == before
    others = {"settings": {"run": "sift_10"}, "images": {"queries": "c"}, "ground truth": {"rows": ((0,), (2,), (1,))}}
    for name, changes in others.items():
        after = inputs(**changes)
        assert {each for each in before if after[each] != before[each]} == {name}


def test_a_folder_with_files_of_others_is_refused(tmp_path):
    for name in ("runs", "tables", "report.html", ".DS_Store"):
        (tmp_path / name).mkdir()
        with lock_output(tmp_path):
            pass
    (tmp_path / "thesis.tex").mkdir()
    with pytest.raises(InputError, match="expected a new or empty folder"), lock_output(tmp_path):
        pass
    assert (tmp_path / "thesis.tex").is_dir()


# Tables

MIX = next(row for row in ROWS if row.name == "mix_hist_50")
TOLERANCES = (1, 2, 5)


def result(system, recall, *, decides=False, **more):
    return {"system": system, "recall_at": {"1": recall, "5": 0.9, "10": 1.0}, "decides": decides, "tolerance": 1,
            "retrieval": {"name": "vlad"}, "features": {"name": "sift", "image_size": [336, 320]}, "candidates": 50,
            "parameters": {}} | more  # fmt: skip


def row_results(recalls, sequences=(OVERALL,)):
    """Recalls at 1 within each tolerance, the same in each sequence."""
    recall = {at: {1: value} for at, value in zip(TOLERANCES, recalls, strict=True)}
    return RowResult(dict.fromkeys(sequences, recall), result("histogram", 0.5))


def make_dataset(name, *sequences, database=10):
    folder = ImageFolder(Path(), tuple(map(str, range(database))))
    return Dataset(name, folder, tuple(QuerySequence(sequence, folder, None) for sequence in sequences or [name]))


def tables_of(evaluations):
    return {name: table for name, _, table in paper_tables(evaluations)}


def test_a_rows_ranking_is_taken_from_its_evaluation():
    rows = {row.name: row for row in ROWS}
    results = [result("retrieval", 0.1), result("histogram", 0.2, decides=True), result("histogram + retrieval", 0.3)]
    recall = {name: row_result(rows[name], results).recall[OVERALL][1][1]
              for name in ("mixvpr", "mix_hist_50", "sift_hist_50", "sift_hist_comb_50")}  # fmt: skip
    assert recall == pytest.approx({"mixvpr": 10, "mix_hist_50": 20, "sift_hist_50": 20, "sift_hist_comb_50": 30})
    assert row_result(rows["sift_anchor"], results) is None


def test_of_several_sequences_the_plain_mean_counts():
    results = [result("histogram", value, decides=True, sequence=name)
               for name, value in (("dawn", 0.1), ("dusk", 0.4), ("mean", 0.25), ("pooled", 0.3))]  # fmt: skip
    recall = row_result(MIX, results).recall
    assert {name: at[1][1] for name, at in recall.items()} == {"dawn": 10, "dusk": 40, OVERALL: 25}


def test_tables_hold_both_numbers():
    assert (beside(None, 84.0), beside(None, None)) == ("(84.0)", "-")
    recall = {at: {1: value, 5: 95.0, 10: 99.0} for at, value in ((1, 81.0), (2, 92.5), (5, 96.0))}
    key = "mix_hist_50", "gardens_point"
    tables = tables_of(Evaluations(
        [MIX], {"gardens_point": make_dataset("gardens_point", database=200)},
        {key: RowResult({OVERALL: recall}, result("histogram", 0.8))}, sizes={key: 200.0},
        seconds={"mix_hist_50": dict(retrieval=0.1, features=0.2, matching=0.3, scores=0.1)},
    ))  # fmt: skip
    assert tables["recall"].rows == [["Mix-hist 50", "81.0 (80.0, +1.0)", "92.5 (92.0, +0.5)", "96.0 (96.0, +0.0)"]]
    assert tables["data_sets"].rows == [["gardens_point", "200 (200, +0)", "200 (200, +0)"]]
    assert tables["sizes"].rows == [["Mix-hist 50", "200.0"]]
    cells = ["0.100 (0.010, +0.090)", "0.200 (0.030, +0.170)", "0.400 (0.070, +0.330)", "0.700 (0.100, +0.600)"]
    assert tables["seconds"].rows == [["Mix-hist 50", *cells]]
    assert tables["averages"].rows[0][1:4] == ["(87.5)", "(92.9)", "(95.0)"]
    assert tables["averages"].header[4:] == [f"of 1 here ±{tolerance}" for tolerance in TOLERANCES]
    assert tables["depths"].header[1:] == [f"gardens_point ±2 R@{k}" for k in (1, 5, 10)]
    assert tables["depths"].rows == [["Mix-hist 50", "92.5", "95.0", "99.0"]]
    assert tables["settings"].rows == [
        ["Mix-hist 50", "vlad", "- (320 x 320)", "sift", "336 x 320 (320 x 320)", "50 (10 or 50)"]
    ]


def test_sequences_have_a_table_of_their_own():
    results = {("mix_hist_50", "robotcar_seasons"): row_results([90.0] * 3, ["night", "snow", OVERALL])}
    dataset = make_dataset("robotcar_seasons", "night", "snow")
    evaluations = Evaluations([MIX], {"robotcar_seasons": dataset}, results)
    [line] = tables_of(evaluations)["sequences_robotcar_seasons"].rows
    assert line[1:4] == ["90.0 (82.0, +8.0)", "90.0 (89.6, +0.4)", "90.0 (93.4, -3.4)"]
    assert line[7:] == ["90.0 (92.8, -2.8)", "90.0 (96.9, -6.9)", "90.0 (98.5, -8.5)"]


def test_averages_over_all_six_are_the_papers():
    recalls = printed_tables()["recall"]["mix_hist_50"]
    results = {("mix_hist_50", name): row_results(values) for name, values in recalls.items()}
    evaluations = Evaluations([MIX], {name: make_dataset(name) for name in recalls}, results)
    [line] = tables_of(evaluations)["averages"].rows
    assert [cell.split(" ")[0] for cell in line[1:4]] == ["87.5", "92.9", "95.0"]
    assert all(cell.endswith("+0.0)") or cell.endswith("-0.0)") for cell in line[1:4])
    assert line[4:] == []
    assert [*mean_recalls(evaluations).values()] == 2 * [{MIX.title: pytest.approx(92.875)}]


def test_rows_that_lack_a_data_set_have_no_mean():
    names, rows = ("corridor", "grief_season"), [row for row in ROWS if row.name in ("sift_hist_50", "sift_anchor")]
    results = {(row.name, name): row_results([50.0] * 3) for row in rows for name in names}
    del results["sift_anchor", "corridor"]
    evaluations = Evaluations(rows, {name: make_dataset(name) for name in names}, results)
    assert [*mean_recalls(evaluations).values()] == [{"SIFT-hist 50": 50.0}]
    assert tables_of(evaluations)["averages"].rows == [["SIFT-hist 50", "-", "-", "-", "50.0", "50.0", "50.0"]]
