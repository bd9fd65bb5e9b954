"""What is evaluated: rows, settings and data sets."""

from pathlib import Path

import pytest

from experiments.paper import systems
from experiments.paper.figures import mean_recalls
from experiments.paper.printed import printed_tables
from experiments.paper.runs import input_fingerprints, settings_of
from experiments.paper.systems import DRAWN, ROWS, Place, chosen_rows, missing_weights, overrides, places
from experiments.paper.tables import OVERALL, Evaluations, RowResult, beside, paper_tables, row_result
from experiments.settings import SettingsError
from experiments.truth import fingerprint
from mfvpr.datasets import Dataset, FrameTruth, ImageFolder, QuerySequence

pytestmark = pytest.mark.thorough

SETTINGS = {"out": "out", "store": None, "memory": None, "devices": 1}
RUNS = list(dict.fromkeys(row.run for row in ROWS))


def made(run, place=DRAWN, root=None):
    chosen = (f"dataset={place}", *([] if root is None else [f"dataset.root={root}"]))
    return settings_of(run, Place(place, chosen, root), SETTINGS)


def test_every_printed_row_is_evaluated():
    known = {row.name for row in ROWS}
    for table in ("recall", "sequences", "sizes", "seconds", "pitts30k"):
        assert {*printed_tables()[table]} <= known, table
    assert len(known) == len(ROWS) == len({row.title for row in ROWS})


@pytest.mark.parametrize("run", RUNS)
def test_every_evaluation_has_settings_of_the_paper(run):
    settings = made(run)
    candidates = {"patch_netvlad": 100, "sift_10": 10, "aliked_10": 10, "mix_hist_10": 10, "mix_hist_comb_10": 10}
    expected = next((number for name, number in candidates.items() if run.startswith(name)), 50)
    assert settings["candidates"] == expected
    sizes = {"mix": [320, 320], "ssm": [336, 336], "selavpr": [224, 224], "patch_netvlad": [640, 480]}
    for name, size in sizes.items():
        if run.startswith(name):
            assert settings["features"]["image_size"] == size
    assert settings["final"] == ("combined" if "comb" in run or "mfvpr" in run else "score")


@pytest.mark.parametrize("run", ["patch_netvlad_performance", "patch_netvlad_speed"])
def test_patch_netvlads_images_are_square_on_robotcar(run, tmp_path):
    settings = made(run, "robotcar_seasons", tmp_path)
    assert settings["features"]["image_size"] == [480, 480]
    assert settings["dataset"]["root"] == str(tmp_path)


def test_thresholds_are_those_of_the_data_set(tmp_path):
    assert made("sift_50")["recall"]["tolerances"] == [1, 2, 5]
    assert made("sift_50", "nordland_27592", tmp_path)["recall"]["tolerances"] == [10]


def test_data_sets_are_found_by_their_names(tmp_path):
    (tmp_path / "Gardens_point_RAS2020").mkdir()
    (tmp_path / "corridor").mkdir()
    found, missing = places(str(tmp_path), None)
    assert [place.name for place in found] == [DRAWN, "corridor", "gardens_point"]
    assert found[2].root == tmp_path / "Gardens_point_RAS2020"
    assert len(missing) == 12
    assert f"grief_season: needs {tmp_path}/grief_season with database and queries" in missing
    assert any(line.startswith("msls_val: needs ") and "https://" in line for line in missing)
    found, missing = places(None, ["corridor", DRAWN])
    assert ([place.name for place in found], len(missing)) == ([DRAWN], 1)
    for arguments, words in (((None, ["x"]), "datasets"), ((str(tmp_path / "no"), None), "expected a folder")):
        with pytest.raises(SettingsError, match=words):
            places(*arguments)


def test_folders_whose_names_tell_positions_are_data_sets(tmp_path):
    for folder in ("pitts30k/images/test", "other", "no positions"):
        for side in ("database", "queries"):
            inside = tmp_path / folder / side
            inside.mkdir(parents=True)
            (inside / ("1.jpg" if folder == "no positions" else "@1@2@.jpg")).touch()
    found, missing = places(str(tmp_path), None)
    assert [place.name for place in found] == [DRAWN, "other", "pitts30k"]
    assert f"dataset.database={tmp_path}/pitts30k/images/test/database" in " ".join(found[2].settings).replace("'", "")
    assert any(line.startswith("pitts30k_test: needs") for line in missing)
    assert [place.name for place in places(str(tmp_path), ["other"])[0]] == ["other"]
    with pytest.raises(SettingsError, match="no positions"):
        places(str(tmp_path), ["no positions"])


def test_rows_are_chosen_by_name():
    assert chosen_rows(None) == ROWS
    assert [row.name for row in chosen_rows(["sift_hist_50", "mixvpr"])] == ["mixvpr", "sift_hist_50"]
    with pytest.raises(SettingsError, match=r"systems=\[best\]: .*patch_netvlad_performance"):
        chosen_rows(["best"])


def test_weights_that_are_missing_are_named(monkeypatch):
    monkeypatch.setattr(systems, "is_installed", lambda entry: False)
    assert [entry.name for entry in missing_weights(made("mix_hist_50"))] == ["d2_tf", "mixvpr_4096"]
    assert [entry.name for entry in missing_weights(made("ssm_vpr"))] == ["vgg16_places365"]
    assert missing_weights(made("sift_50")) == []


def test_a_run_is_known_by_what_decides_its_numbers(tmp_path, monkeypatch):
    images = {"database": "a", "queries": "b"}
    first = input_fingerprints(made("sift_50", "corridor", tmp_path / "a"), images, None)
    assert first == input_fingerprints(made("sift_50", "corridor", tmp_path / "b") | {"out": "elsewhere"}, images, None)
    assert first["settings"] != input_fingerprints(made("sift_10", "corridor", tmp_path), images, None)["settings"]
    assert first["images"] != input_fingerprints(made("sift_50", "corridor", tmp_path), images | {"queries": "c"}, None)["images"]


def test_overrides_of_all_rows_are_few():
    assert overrides("mix_hist_50", DRAWN) == ("system=mix_hist_50",)
    assert "candidates=50" in overrides("selavpr_msls", DRAWN)


# Tables


def result(system, recall, *, decides=False, **more):
    return {"system": system, "recall_at": {"1": recall, "5": 0.9, "10": 1.0}, "decides": decides, "tolerance": 1,
            "filter": {"name": "vlad"}, "features": {"name": "sift", "image_size": [336, 320]}, "candidates": 50,
            "parameters": {}} | more  # fmt: skip


def dataset(name, *parts, database=10):
    folder = ImageFolder(Path(), tuple(map(str, range(database))))
    return Dataset(name, folder, tuple(QuerySequence(part, folder, None) for part in parts))


def test_numbers_stand_beside_the_printed():
    assert beside(84.16, 84.0) == "84.2 (84.0, +0.2)"
    assert beside(None, 84.0) == "(84.0)"
    assert beside(84.16, None) == "84.2"
    assert beside(None, None) == "-"
    assert beside(83.94, 84.0) == "83.9 (84.0, -0.1)"


def test_a_rows_ranking_is_taken_from_its_evaluation():
    rows = {row.name: row for row in ROWS}
    results = [result("filter", 0.1), result("histogram", 0.2, decides=True), result("histogram + filter", 0.3)]
    recall = {name: row_result(rows[name], results).recall[OVERALL][1][1]
              for name in ("mixvpr", "mix_hist_50", "sift_hist_50", "sift_hist_comb_50")}  # fmt: skip
    assert recall == pytest.approx({"mixvpr": 10, "mix_hist_50": 20, "sift_hist_50": 20, "sift_hist_comb_50": 30})
    assert row_result(rows["sift_anchor"], results) is None


def test_of_several_sequences_the_plain_mean_counts():
    row = next(row for row in ROWS if row.name == "mix_hist_50")
    results = [result("histogram", value, decides=True, sequence=name)
               for name, value in (("dawn", 0.1), ("dusk", 0.4), ("mean", 0.25), ("pooled", 0.3))]  # fmt: skip
    one = row_result(row, results)
    assert {name: at[1][1] for name, at in one.recall.items()} == {"dawn": 10, "dusk": 40, OVERALL: 25}


def test_tables_hold_both_numbers():
    row = next(row for row in ROWS if row.name == "mix_hist_50")
    recall = {at: {1: value, 5: 95.0, 10: 99.0} for at, value in ((1, 81.0), (2, 92.5), (5, 96.0))}
    one = RowResult({OVERALL: recall}, result("histogram", 0.8))
    gardens = dataset("gardens_point", "gardens_point", database=200)
    found = Evaluations([row], {"gardens_point": gardens},
                  {("mix_hist_50", "gardens_point"): one}, sizes={("mix_hist_50", "gardens_point"): 2.0**20},
                  seconds={"mix_hist_50": dict(filter=0.1, features=0.2, matching=0.3, scores=0.1)})  # fmt: skip
    made = {name: table for name, _, table in paper_tables(found)}
    assert made["recall"].rows == [["Mix-hist 50", "81.0 (80.0, +1.0)", "92.5 (92.0, +0.5)", "96.0 (96.0, +0.0)"]]
    assert made["data_sets"].rows == [["gardens_point", "200 (200, +0)", "200 (200, +0)"]]
    assert made["sizes"].rows == [["Mix-hist 50", "200.0"]]
    assert made["seconds"].rows == [["Mix-hist 50", "0.100 (0.01)", "0.200 (0.03)", "0.400 (0.07)", "0.700 (0.10)"]]
    assert made["averages"].rows[0][1:4] == ["(87.5)", "(92.9)", "(95.0)"]
    assert made["averages"].header[4:] == [f"of 1 here ±{tolerance}" for tolerance in (1, 2, 5)]
    assert made["depths"].rows == [["Mix-hist 50", "gardens_point ±2", "92.5", "95.0", "99.0"]]
    assert made["settings"].rows == [
        ["Mix-hist 50", "vlad", "- (320 x 320)", "sift", "336 x 320 (320 x 320)", "50 (10 or 50)"]
    ]


def test_sequences_have_a_table_of_their_own():
    row = next(row for row in ROWS if row.name == "mix_hist_50")
    recall = {part: {at: {1: 90.0} for at in (1, 2, 5)} for part in ("night", "snow", OVERALL)}
    found = Evaluations([row], {"robotcar_seasons": dataset("robotcar_seasons", "night", "snow")},
                  {("mix_hist_50", "robotcar_seasons"): RowResult(recall, result("histogram", 0.9))})  # fmt: skip
    made = {name: table for name, _, table in paper_tables(found)}
    [line] = made["sequences_robotcar_seasons"].rows
    assert line[1:4] == ["90.0 (82.0, +8.0)", "90.0 (89.6, +0.4)", "90.0 (93.4, -3.4)"]
    assert line[7:] == ["90.0 (92.8, -2.8)", "90.0 (96.9, -6.9)", "90.0 (98.5, -8.5)"]


def test_averages_over_all_six_are_the_papers():
    row = next(row for row in ROWS if row.name == "mix_hist_50")
    names = printed_tables()["recall"]["mix_hist_50"]
    recalls = {name: {at: {1: value} for at, value in zip((1, 2, 5), values, strict=True)}
               for name, values in names.items()}  # fmt: skip
    results = {("mix_hist_50", name): RowResult({OVERALL: recall}, result("histogram", 0.5))
               for name, recall in recalls.items()}  # fmt: skip
    found = Evaluations([row], {name: dataset(name, name) for name in names}, results)
    [line] = {name: table for name, _, table in paper_tables(found)}["averages"].rows
    assert [cell.split(" ")[0] for cell in line[1:4]] == ["87.5", "92.9", "95.0"]
    assert all(cell.endswith("+0.0)") or cell.endswith("-0.0)") for cell in line[1:4])
    assert line[4:] == []
    assert [*mean_recalls(found).values()] == 2 * [{row.title: pytest.approx(92.875)}]


def test_rows_that_lack_a_data_set_have_no_mean():
    some = [row for row in ROWS if row.name in ("sift_hist_50", "sift_anchor")]
    recall = {at: {1: 50.0} for at in (1, 2, 5)}
    results = {(row.name, name): RowResult({OVERALL: recall}, result("histogram", 0.5))
               for row in some for name in ("corridor", "grief_season")}  # fmt: skip
    del results["sift_anchor", "corridor"]
    found = Evaluations(some, {name: dataset(name, name) for name in ("corridor", "grief_season")}, results)
    assert [*mean_recalls(found).values()] == [{"SIFT-hist 50": 50.0}]
    [line] = {name: table for name, _, table in paper_tables(found)}["averages"].rows
    assert line == ["SIFT-hist 50", "50.0", "50.0", "50.0"]


def test_data_sets_that_lack_images_are_called_so():
    row = next(row for row in ROWS if row.name == "mix_hist_50")
    one = RowResult({OVERALL: {at: {1: 90.0} for at in (1, 2, 5)}}, result("histogram", 0.9))
    found = Evaluations(
        [row], {"gardens_point": dataset("gardens_point", "gardens_point")}, {(row.name, "gardens_point"): one}
    )
    headings = {name: (heading, table.header) for name, heading, table in paper_tables(found)}
    assert headings["recall"][1][1] == "gardens_point (incomplete) ±1"
    assert "here over gardens_point (incomplete)" in headings["averages"][0]
    assert "brackets" not in headings["depths"][0]


def test_another_ground_truth_of_the_same_images_is_another_run(tmp_path):
    folder, settings = ImageFolder(Path(), ("0", "1", "2")), made("sift_50", "corridor", tmp_path)
    known = []
    for rows in (((0,), (1,), (2,)), ((0,), (2,), (1,))):
        dataset = Dataset("corridor", folder, (QuerySequence("one", folder, FrameTruth(rows, 3)),))
        known.append(input_fingerprints(settings, {}, fingerprint(dataset, [1])))
    assert {name for name in known[0] if known[0][name] != known[1][name]} == {"ground truth"}
    assert fingerprint(Dataset("corridor", folder, (QuerySequence("one", folder, None),)), []) is None
