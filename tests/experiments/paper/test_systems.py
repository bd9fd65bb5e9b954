"""Rows, settings and data sets of the evaluations, and the tables of their numbers."""

import time
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.paper import runs, systems
from experiments.paper.runs import input_fingerprints, lock_output, settings_of
from experiments.paper.systems import DRAWN, ROWS, Place, missing_weights, places
from experiments.paper.tables import OVERALL, Evaluations, beside, paper_tables, printed_tables, recalls_of
from mfvpr import datasets
from mfvpr.cli.schema import Paper
from mfvpr.datasets import Dataset, FrameTruth, ImageFolder, QuerySequence
from mfvpr.datasets.streets import streets_folder
from mfvpr.features import Sift
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
    speed = compose("patch_netvlad_speed", "robotcar_seasons", tmp_path)
    assert (speed.features["image_size"], speed.scorer["size"]) == ([480, 480], [400, 400])
    assert compose("sift_50").recall.tolerances == [1, 2, 5]
    assert compose("sift_50", "nordland_27592", tmp_path).recall.tolerances == [10]


def test_data_sets_are_found_by_their_names(tmp_path):
    (tmp_path / "Gardens_point_RAS2020").mkdir()
    (tmp_path / "corridor").mkdir()
    available, left_out = places(str(tmp_path), None)
    assert [place.name for place in available] == [DRAWN, "corridor", "gardens_point"]
    assert f"dataset.root='{tmp_path}/Gardens_point_RAS2020'" in available[2].settings
    assert len(left_out) == 12
    assert left_out[0] == ("grief_season", f"needs {tmp_path}/grief_season with database and queries")
    assert "https://" in dict(left_out)["msls_val"]
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
    assert dict(left_out)["pitts30k_test"].startswith("needs ")


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

MIX, ANCHOR, SIFT = (
    next(row for row in ROWS if row.name == name) for name in ("mix_hist_50", "sift_anchor", "sift_hist_50")
)


def recalls(row, dataset, values, sequences=(OVERALL,)):
    """Recalls at 1 within each tolerance, the same in each sequence."""
    return {
        (row.name, dataset, name, at, 1): value
        for name in sequences
        for at, value in zip((1, 2, 5), values, strict=True)
    }


def make_dataset(name, *sequences, database=10):
    folder = ImageFolder(Path(), tuple(map(str, range(database))))
    return Dataset(name, folder, tuple(QuerySequence(sequence, folder, None) for sequence in sequences or [name]))


def tables_of(rows, datasets, values, **more):
    evaluations = Evaluations(rows, {dataset.name: dataset for dataset in datasets}, values, **more)
    return {name: table for name, _, table in paper_tables(evaluations)}


def test_a_rows_ranking_is_taken_from_its_evaluation():
    systems = {"retrieval": 0.1, "histogram": 0.2, "histogram + retrieval": 0.3}
    results = [{"system": system, "decides": system == "histogram", "tolerance": 1, "recall_at": {"1": recall}}
               for system, recall in systems.items()]  # fmt: skip
    rows = {row.name: row for row in ROWS}
    expected = {"mixvpr": 10, "mix_hist_50": 20, "sift_hist_50": 20, "sift_hist_comb_50": 30}
    for name, recall in expected.items():
        assert recalls_of(rows[name], "x", results) == {(name, "x", OVERALL, 1, 1): pytest.approx(recall)}
    assert recalls_of(ANCHOR, "x", results) == {}


def test_of_several_sequences_the_plain_mean_counts():
    results = [{"decides": True, "sequence": name, "radius": 25, "recall_at": {"5": value}}
               for name, value in (("dawn", 0.1), ("dusk", 0.4), ("mean", 0.25), ("pooled", 0.3))]  # fmt: skip
    by_sequence = {name: recall for (_, _, name, _, _), recall in recalls_of(MIX, "x", results).items()}
    assert by_sequence == {"dawn": 10, "dusk": 40, OVERALL: 25}


def test_tables_hold_both_numbers():
    assert (beside(None, 84.0), beside(None, None)) == ("(84.0)", "-")
    known = {(MIX.name, "gardens_point", OVERALL, at, k): value for at, first in ((1, 81.0), (2, 92.5), (5, 96.0))
             for k, value in ((1, first), (5, 95.0), (10, 99.0))}  # fmt: skip
    pittsburgh = {(MIX.name, "pitts30k_val", OVERALL, 25, k): value for k, value in ((1, 80.0), (5, 90.0), (10, 91.0))}
    datasets = make_dataset("gardens_point", database=200), make_dataset("pitts30k_val")
    seconds = {MIX.name: dict(retrieval=0.1, features=0.2, matching=0.3, scores=0.1)}
    sizes = {(MIX.name, "gardens_point"): 200.0}
    tables = tables_of([MIX, SIFT], datasets, known | pittsburgh, sizes=sizes, seconds=seconds)
    first = ["Mix-hist 50", "81.0 (80.0, +1.0)", "92.5 (92.0, +0.5)", "96.0 (96.0, +0.0)"]
    assert [row[:4] for row in tables["recall"].rows] == [first]
    assert tables["data_sets"].rows[0] == ["gardens_point", "200 (200, +0)", "200 (200, +0)"]
    assert tables["sizes"].rows == [["Mix-hist 50", "200.0", "-"]]
    cells = ["0.100 (0.010, +0.090)", "0.200 (0.030, +0.170)", "0.400 (0.070, +0.330)", "0.700 (0.100, +0.600)"]
    assert tables["seconds"].rows == [["Mix-hist 50", *cells]]
    assert tables["averages"].rows[0][1:4] == ["(87.5)", "(92.9)", "(95.0)"]
    assert tables["averages"].header[4:] == [f"of 1 here ±{tolerance}" for tolerance in (1, 2, 5)]
    depths = [f"gardens_point ±2 R@{k}" for k in (1, 5, 10)] + [
        f"pitts30k_val (incomplete) ±25 R@{k}" for k in (1, 5, 10)
    ]
    assert tables["depths"].header[1:] == depths
    assert tables["depths"].rows[0][1:4] == ["92.5 (92.0, +0.5)", "95.0", "99.0"]
    printed = printed_tables()["pitts30k"][MIX.name]
    assert [cell.partition(",")[0] for cell in tables["depths"].rows[0][4:]] == [
        f"{ours} ({theirs}" for ours, theirs in zip((80.0, 90.0, 91.0), printed, strict=True)
    ]


def test_sequences_have_a_table_of_their_own():
    values = recalls(MIX, "robotcar_seasons", [90.0] * 3, ["night", "snow", OVERALL])
    [line] = tables_of([MIX], [make_dataset("robotcar_seasons", "night", "snow")], values)[
        "sequences_robotcar_seasons"
    ].rows
    assert line[1:4] == ["90.0 (82.0, +8.0)", "90.0 (89.6, +0.4)", "90.0 (93.4, -3.4)"]
    assert line[7:] == ["90.0 (92.8, -2.8)", "90.0 (96.9, -6.9)", "90.0 (98.5, -8.5)"]


def test_averages_over_all_six_are_the_papers():
    printed, values = printed_tables()["recall"][MIX.name], {}
    for name, each in printed.items():
        values |= recalls(MIX, name, each)
    lines = tables_of([MIX, ANCHOR], [*map(make_dataset, printed)], values)["averages"].rows
    assert [cell.split(" ")[0] for cell in lines[0][1:4]] == ["87.5", "92.9", "95.0"]
    assert all(cell.endswith(("+0.0)", "-0.0)")) for cell in lines[0][1:4])
    assert (len(lines), lines[0][4:]) == (1, [])
    for name in printed:
        values |= recalls(ANCHOR, name, [50.0] * 3)
    del values[MIX.name, "gardens_point", OVERALL, 1, 1]
    lines = tables_of([MIX, ANCHOR], [*map(make_dataset, printed)], values)["averages"].rows
    assert [line[1:] for line in lines] == [["(87.5)", "(92.9)", "(95.0)"], ["50.0"] * 3]


def test_rows_that_lack_a_data_set_have_no_mean():
    names = "corridor", "grief_season"
    values = recalls(ANCHOR, names[0], [70.0] * 3)
    for name in names:
        values |= recalls(SIFT, name, [50.0] * 3)
    averages = tables_of([SIFT, ANCHOR], [*map(make_dataset, names)], values)["averages"]
    assert averages.rows == [["SIFT-hist 50", "-", "-", "-", "50.0", "50.0", "50.0"]]


# Seconds


def test_seconds_of_a_query_include_its_extraction_and_not_that_of_the_database(monkeypatch, tmp_path):
    street, described, extract = streets_folder(tmp_path, num_frames=4, image_size=(160, 120)), [], Sift.__call__
    dataset = datasets.folder(street / "database", street / "queries", ground_truth="order")

    def extract_slowly(self, images):
        time.sleep(0.2 * len(images))
        described.append(len(images))
        return extract(self, images)

    monkeypatch.setattr(Sift, "__call__", extract_slowly)
    monkeypatch.setattr(runs, "QUERIES", 2)
    seconds = runs.measure_query(compose("sift_10"), dataset)
    assert seconds["retrieval"] + seconds["features"] >= 0.2
    assert sum(described) == 4 + 2 * 2  # the queries twice
