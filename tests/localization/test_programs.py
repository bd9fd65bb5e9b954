"""A map as programs build it and localize images in it."""

import json
import shutil
import signal
import subprocess
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from mfvpr.datasets import read_image
from mfvpr.datasets.image_reading import read_frames
from mfvpr.evaluation import write_confidences
from mfvpr.localization import Map
from mfvpr.localization.map_settings import read_settings
from mfvpr.systems import assembly
from mfvpr.utils import InputError
from tests.localization.test_map import SURE
from tests.programs import MFVPR, ROOT, output_of

pytestmark = pytest.mark.thorough

QUICK = ["features.max_keypoints=60", "features.image_size=[160,120]", "retrieval.num_words=8", "candidates=5"]
NAMES = [f"{row:04d}.png" for row in range(10)]
WAIT = "10 images in the map; the first image takes longer\n"


@pytest.fixture
def call_program(monkeypatch, capsys):
    """Runs a program: output and errors, without the line that says why the first prediction takes long."""

    def call(program, *arguments, code=0):
        stdout, stderr = output_of(monkeypatch, capsys, program, *arguments, code=code)
        return stdout, "".join(line for line in stderr.splitlines(True) if not line.endswith(WAIT[10:]))

    return call


@pytest.fixture
def build_map(call_program):
    """Builds a map of a street: output and errors."""

    def call(folder, street, *more, code=0):
        data = ["dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
                "dataset.ground_truth=none"]  # fmt: skip
        return call_program("map", "build", f"map={folder}", *data, *QUICK, *more, code=code)

    return call


@pytest.fixture
def folder(small_street, tmp_path, build_map):
    stdout, _ = build_map(tmp_path / "map", small_street)
    assert stdout == f"{tmp_path}/map: 10 images, 10 of them new\n"
    return tmp_path / "map"


@pytest.fixture
def localize(call_program, tmp_path):
    """Localizes images: lines and errors."""

    def call(images, *more, folder=tmp_path / "map", code=0):
        stdout, stderr = call_program("localize", f"map={folder}", f"images={images}", *more, code=code)
        return [json.loads(line) for line in stdout.splitlines()], stderr

    return call


@pytest.fixture
def queries(tmp_path):
    (tmp_path / "queries").mkdir()
    return tmp_path / "queries"


def values_of(name, lines):
    return [line[name] for line in lines]


def write_gray(path, size=(20, 30)):
    """An image without features."""
    Image.fromarray(np.full((*size, 3), 90, np.uint8)).save(path)


def test_images_of_a_folder_are_localized(folder, small_street, monkeypatch, capsys):
    arguments = [f"map={folder}", f"images={small_street}/database", "alternatives=2", "field_of_view=70"]
    stdout, stderr = output_of(monkeypatch, capsys, "localize", *arguments)
    assert stderr == WAIT
    lines = [json.loads(line) for line in stdout.splitlines()]
    assert values_of("place", lines) == NAMES
    assert {len(line["alternatives"]) for line in lines} == {2}
    assert all(line["confidence"] is None and line["seconds"] > 0 for line in lines)
    focal = 320 / 2 / np.tan(np.deg2rad(35))
    for line in lines:
        points = [line["shift"], *line["shift_interval"]]
        np.testing.assert_allclose(line["shift_angles"], [np.rad2deg(np.arctan(x / focal)) for x, _ in points])
        assert (line["image_width"], line["shift_fraction"][0]) == (320, line["shift"][0] / 320)


def test_images_are_added_unless_they_are_in_the_map(folder, small_street, call_program, build_map, localize):
    stdout, _ = build_map(folder, small_street)
    assert stdout == f"{folder}: 10 images, 0 of them new\n"
    stdout, _ = call_program("map", "info", folder)
    assert stdout.startswith(f"{folder}: 10 images, 0.")
    assert json.loads(stdout.partition("\n")[2])["candidates"] == 5
    image = small_street / "queries" / "0009.png"
    new = shutil.copy(image, folder.parent / "new.png")
    stdout, _ = call_program("map", "add", folder, new, "--place", "the last")
    assert stdout == f"{new}: added, 11 images\n"
    assert localize(image)[0][0]["place"] == "the last"
    assert localize(image, "recent=1")[0][0]["place"] != "the last"
    _, stderr = call_program("map", "add", folder, new, code=2)
    assert "new.png: the map has an image" in stderr


@pytest.fixture
def video(small_street, tmp_path):
    path = tmp_path / "drive.avi"
    images = [read_image(file) for file in sorted((small_street / "database").iterdir())]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 5, images[0].shape[1::-1])
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    return path


def test_frames_of_a_video_are_localized(folder, video, small_street, localize):
    lines, _ = localize(video, "every=3")
    assert [(line["image"], line["place"]) for line in lines] == [
        (f"{video}:{row}", f"{row:04d}.png") for row in (0, 3, 6, 9)
    ]
    [(_, first), *_] = read_frames(video)
    expected = read_image(small_street / "database/0000.png")
    assert first.shape == expected.shape
    assert np.abs(first.astype(int) - expected).mean() < 4  # a JPEG of it


def test_files_that_are_no_video(tmp_path):
    (tmp_path / "a.mp4").write_text("text")
    for path, words in ((tmp_path / "a.mp4", "without frames"), (tmp_path, "a folder"), (tmp_path / "no", "nothing")):
        with pytest.raises(InputError, match=words):
            list(read_frames(path))


@pytest.mark.parametrize(("arguments", "words"), [
    (["map=/no/such", "images=/no"], "/no/such: expected a folder with a map, got none"),
    (["map=MAP", "images=/no"], "images=/no: expected an image"),
    (["map=MAP", "images=MAP/map.sqlite", "watch=true"], "watch=true: expected images=DIR, one folder"),
    (["map=MAP", "images=MAP", "figures=3"], "figures=3: expected out=DIR"),
    (["map=MAP", "images=MAP", "figures=1", "out=MAP/figures", "root=/no"], "root=/no: expected the folder of the map"),
])  # fmt: skip
def test_mistakes_are_one_line(folder, call_program, arguments, words):
    stdout, stderr = call_program("localize", *(argument.replace("MAP", str(folder)) for argument in arguments), code=2)
    assert stdout == ""
    assert words in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize(("more", "words"), [
    (["features.max_keypoints=50"], "was made with other features"),
    (["retrieval.whiten=4"], "a map needs retrieval by global descriptors without whitening"),
    (["scorer=paper"], "was made with other scorer"),
    (["map=STREET"], "expected a new or empty folder, or a map"),
])  # fmt: skip
def test_other_settings_are_refused(folder, small_street, build_map, more, words):
    changes = [setting.replace("STREET", str(small_street)) for setting in more]
    _, stderr = build_map(folder, small_street, *changes, code=2)
    assert words in stderr


@pytest.mark.slow
def test_answers_are_drawn(folder, small_street, tmp_path, localize):
    queries, pictures = small_street / "queries", {}
    for name, root in (("gray", "null"), ("shown", f"{small_street}/database")):
        lines, stderr = localize(queries, "figures=[0003.png,5]", f"out={tmp_path}/{name}", f"root={root}")
        assert stderr == ""
        paths = [tmp_path / name / "0003_0003.png", tmp_path / name / "0005_0005.png"]
        assert [line["figure"] for line in lines if "figure" in line] == [*map(str, paths)]
        assert sorted((tmp_path / name).iterdir()) == paths
        with Image.open(paths[0]) as image:
            pictures[name] = np.asarray(image.convert("RGB"))
            assert (image.text["image"], image.text["place"]) == (f"{queries}/0003.png", lines[3]["place"])
    gray = {name: np.mean((picture == 150).all(axis=2)) for name, picture in pictures.items()}
    assert gray["shown"] < 0.01 < 0.1 < gray["gray"]


def test_figures_are_drawn_without_a_candidate_and_missing_images_are_named(folder, tmp_path, queries, localize):
    for name in ("a b.png", "c.png"):
        write_gray(queries / name)
    lines, stderr = localize(queries, "figures=1", f"out={tmp_path}/out")
    assert stderr == ""
    assert [(line["place"], line["reason"]) for line in lines] == [(None, "too few features")] * 2
    _, stderr = localize(queries, "figures=[no.png,c.png,10]", f"out={tmp_path}/out", code=2)
    assert stderr.startswith("error: figures=[10,no.png]: expected rows")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0000_a b.png", "0001_c.png"]


def test_a_map_shows_nothing_outside_of_its_folder(folder, small_street, tmp_path, localize):
    """Its names are data: of a map that somebody gave away they may say anything."""
    query = small_street / "queries/0004.png"
    Map.open(folder).add(query, "there", name=f"..{query}")
    [line], stderr = localize(query, "figures=1", f"out={tmp_path}/out", f"root={small_street}/database", code=2)
    assert line["place"] == "there"
    assert "one that leads elsewhere" in stderr
    assert not (tmp_path / "out").exists()


def test_a_route_goes_on_where_an_image_is_wrong_or_says_nothing(folder, small_street, tmp_path, localize):
    drive = shutil.copytree(small_street / "database", tmp_path / "drive")
    (drive / "0004.png").write_text("no image")
    shutil.copy(drive / "0000.png", drive / "0006.png")
    write_gray(drive / "0008.png")
    lines, stderr = localize(drive, "route=auto", code=2)
    assert "1 of the images could not be localized" in stderr
    places = [line.get("place") for line in lines]
    assert places == [*NAMES[:4], None, NAMES[5], NAMES[0], NAMES[7], None, NAMES[9]]
    assert "0004.png: " in lines[4]["error"]
    assert [line["route"]["place"] for line in lines] == NAMES
    assert all(0 < line["route"]["p"] <= 1 for line in lines)
    assert lines[-1]["route"]["advance"] == pytest.approx(1, abs=0.3)
    write_confidences(tmp_path / "c.json", {"histogram": replace(SURE, bias=2.0)}, {"settings": {}})
    _, stderr = localize(small_street / "database", "route=9", f"confidence={tmp_path}/c.json")
    assert "warning: route=9: the images fit " in stderr
    plain, _ = localize(drive, code=2)
    assert [line.get("place") for line in plain] == places
    assert all("route" not in line and "added" not in line for line in plain)


@pytest.fixture
def twice(small_street, tmp_path):
    """A drive that passes eight places, and passes them again."""
    (tmp_path / "drive").mkdir()
    for number in range(16):
        shutil.copy(small_street / f"database/{number % 8:04d}.png", tmp_path / f"drive/{number:02d}.png")
    return tmp_path / "drive"


def without_seconds(lines):
    return [{name: value for name, value in line.items() if name not in ("seconds", "added")} for line in lines]


def test_a_drive_finds_where_it_was_before(twice, small_street, tmp_path, build_map, localize):
    start = tmp_path / "start"
    (start / "database").mkdir(parents=True)
    shutil.copytree(twice, start / "queries")
    for number in (8, 9):  # which the drive does not pass
        shutil.copy(small_street / f"database/{number:04d}.png", start / "database")
    build_map(tmp_path / "map", start)
    write_gray(twice / "16.png", (240, 320))
    settings = ("add=true", "recent=3", "route=1")
    first, stderr = localize(twice, *settings)
    assert stderr == ""
    names = [f"{twice}/{number:02d}.png" for number in range(17)]
    assert values_of("image", first) == names
    assert all(values_of("added", first))
    assert values_of("place", first)[8:] == [*names[:8], None]  # the second time, where it was the first
    for number, line in enumerate(first):  # nothing of the newest three, nor of itself
        assert all(alternative["row"] < 2 + number - 3 for alternative in line["alternatives"])
    assert values_of("route", first[:2]) == [None, None]  # while the map has three images at most
    assert Map.open(tmp_path / "map").names[2:] == names
    again, _ = localize(twice, *settings)  # each sees the images before it, also after an interruption
    assert without_seconds(again) == without_seconds(first)
    assert not any(values_of("added", again))
    assert len(Map.open(tmp_path / "map")) == 19


def test_a_prediction_is_printed_even_if_the_image_cannot_be_added(folder, small_street, call_program, monkeypatch):
    def fail(*_):
        raise InputError("the disk is full")

    monkeypatch.setattr(Map, "add_described", fail)
    image = small_street / "queries" / "0003.png"
    stdout, stderr = call_program("localize", f"map={folder}", f"images={image}", "add=true", code=2)
    [line] = map(json.loads, stdout.splitlines())
    assert line["place"] in NAMES
    assert "added" not in line
    assert stderr.splitlines()[-1] == "error: the disk is full"


def test_confidences_of_other_settings_are_named(folder, small_street, tmp_path, localize):
    settings = read_settings(folder)
    for candidates, absent in ((settings["candidates"], 0), (settings["candidates"] + 1, 7)):
        same = {name: settings[name] for name in ("features", "retrieval", "matching")}
        origin = {
            "settings": same | {"scorer": assembly.describe_settings(settings["scorer"])},
            "candidates": candidates,
            "absent_queries": absent,
        }
        write_confidences(tmp_path / "c.json", {"histogram": SURE}, origin)
        [line], stderr = localize(small_street / "database/0001.png", f"confidence={tmp_path}/c.json")
        assert 0 <= line["confidence"] <= 1
        assert ("other settings of candidates" in stderr) == (candidates != settings["candidates"])
        assert ("fitted without absent places" in stderr) == (absent == 0)


def test_a_map_is_calibrated(folder, small_street, call_program, localize):
    with pytest.warns(UserWarning, match="calibrate on a longer drive$"):  # ten frames
        stdout, _ = call_program("map", "calibrate", folder, small_street / "database", small_street / "queries")
    assert stdout.startswith(f"calibrated on {small_street}/queries: 10 queries, ")
    assert stdout.split(";")[0] in call_program("map", "info", folder)[0]
    [line], _ = localize(small_street / "database/0001.png", "threshold=0")
    assert 0 < line["confidence"] < 1


@pytest.mark.slow
def test_new_images_of_a_folder_are_localized(folder, small_street, queries):
    command = [*MFVPR, "localize", f"map={folder}", f"images={queries}", "watch=true"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr.readline() == f"watching {queries}; end with Ctrl-C\n"
        for row in (3, 5):
            content = (small_street / f"database/{row:04d}.png").read_bytes()
            with (queries / f"{row}.png").open("wb") as file:
                file.write(content[:2000])
                file.flush()
                time.sleep(0.05)
                file.write(content[2000:])
            assert json.loads(running.stdout.readline())["place"] == f"{row:04d}.png"
        slow = queries / "slow.png"  # by a writer that rests: an error, and localized when it is whole
        slow.write_bytes(content[:2000])
        assert "slow.png" in json.loads(running.stdout.readline())["error"]
        slow.write_bytes(content)
        assert json.loads(running.stdout.readline())["place"] == "0005.png"
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 130
