"""A map as programs make and ask it."""

import json
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from mfvpr.data.images import read_image
from mfvpr.data.videos import frames
from mfvpr.errors import InputError
from tests.programs import ROOT, typed

QUICK = ["features.max_keypoints=60", "features.image_size=[160,120]", "retrieval.num_words=8", "candidates=5"]


def called(monkeypatch, capsys, program, *arguments):
    return typed(monkeypatch, capsys, program, *map(str, arguments))


def built(folder, street, monkeypatch, capsys, *more):
    data = ["dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
            "dataset.ground_truth=none"]  # fmt: skip
    return called(monkeypatch, capsys, "map", "build", f"map={folder}", *data, *QUICK, *more)


@pytest.fixture
def folder(small_street, tmp_path, monkeypatch, capsys):
    code, stdout, stderr = built(tmp_path / "map", small_street, monkeypatch, capsys)
    assert code == 0, stderr
    assert stdout == f"{tmp_path}/map: 10 images, 10 of them new\n"
    return tmp_path / "map"


def lines(stdout):
    return [json.loads(line) for line in stdout.splitlines()]


def test_a_folder_is_asked(folder, small_street, monkeypatch, capsys):
    code, stdout, _ = called(monkeypatch, capsys, "localize", f"map={folder}", f"images={small_street}/database",
                             "alternatives=2")  # fmt: skip
    assert code == 0
    found = lines(stdout)
    assert [line["place"] for line in found] == [f"{row:04d}.png" for row in range(10)]
    assert {len(line["alternatives"]) for line in found} == {2}
    assert all(line["p_right"] is None and line["seconds"] > 0 and len(line["shift"]) == 2 for line in found)


def test_what_is_there_is_not_added_again(folder, small_street, monkeypatch, capsys):
    code, stdout, _ = built(folder, small_street, monkeypatch, capsys)
    assert (code, stdout) == (0, f"{folder}: 10 images, 0 of them new\n")
    code, stdout, _ = called(monkeypatch, capsys, "map", "info", folder)
    assert code == 0
    assert stdout.startswith(f"{folder}: 10 images, 0.")
    assert json.loads(stdout.partition("\n")[2])["candidates"] == 5


def test_images_are_added(folder, small_street, monkeypatch, capsys):
    image = small_street / "queries" / "0009.png"
    code, stdout, _ = called(monkeypatch, capsys, "map", "add", folder, shutil.copy(image, folder.parent / "new.png"),
                             "--place", "the last")  # fmt: skip
    assert (code, stdout) == (0, f"{folder.parent}/new.png: added, 11 images\n")
    code, stdout, _ = called(monkeypatch, capsys, "localize", f"map={folder}", f"images={image}")
    assert lines(stdout)[0]["place"] == "the last"
    code, stdout, _ = called(monkeypatch, capsys, "localize", f"map={folder}", f"images={image}", "recent=1")
    assert lines(stdout)[0]["place"] != "the last"
    code, _, stderr = called(monkeypatch, capsys, "map", "add", folder, folder.parent / "new.png")
    assert code == 2
    assert "new.png: the map has an image of this name" in stderr


@pytest.fixture
def video(small_street, tmp_path):
    path = tmp_path / "drive.avi"
    images = [read_image(one) for one in sorted((small_street / "database").iterdir())]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 5, images[0].shape[1::-1])
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    return path


def test_a_video_is_asked(folder, video, small_street, monkeypatch, capsys):
    code, stdout, _ = called(monkeypatch, capsys, "localize", f"map={folder}", f"images={video}", "every=3")
    assert code == 0
    assert [(line["image"], line["place"]) for line in lines(stdout)] == [
        (f"{video}:{row}", f"{row:04d}.png") for row in (0, 3, 6, 9)
    ]
    [(_, first), *_] = frames(video)
    expected = read_image(small_street / "database/0000.png")
    assert first.shape == expected.shape
    assert np.abs(first.astype(int) - expected).mean() < 4  # a JPEG of it


def test_what_is_no_video(tmp_path):
    (tmp_path / "a.mp4").write_text("text")
    for path, words in ((tmp_path / "a.mp4", "without frames"), (tmp_path, "a folder"), (tmp_path / "no", "nothing")):
        with pytest.raises(InputError, match=words):
            list(frames(path))


def test_an_image_that_cannot_be_read_stops_no_other(folder, small_street, tmp_path, monkeypatch, capsys):
    (tmp_path / "asked").mkdir()
    (tmp_path / "asked/0.png").write_text("no image")
    shutil.copy(small_street / "database/0004.png", tmp_path / "asked/1.png")
    code, stdout, stderr = called(monkeypatch, capsys, "localize", f"map={folder}", f"images={tmp_path}/asked")
    assert code == 2
    first, second = lines(stdout)
    assert "0.png: " in first["error"]
    assert second["place"] == "0004.png"
    assert "1 of the images could not be answered" in stderr


@pytest.mark.parametrize(("arguments", "words"), [
    (["map=/no/such", "images=/no"], "map=/no/such: expected a folder with a map, got none"),
    (["images=/no"], "map: this setting has no default"),
    (["map=MAP", "images=/no"], "images=/no: expected an image, a folder or a video, got nothing"),
    (["map=MAP", "images=MAP/settings.json", "watch=true"], "watch=true: expected images=DIR, one folder"),
    (["map=MAP", "images=MAP", "threshold=0.5"], "expected confidence=FILE as well"),
    (["map=MAP", "images=MAP", "confidence=/no"], "/no: expected the confidence.json"),
    (["map=MAP", "images=MAP", "every=0"], "every=0: expected"),
])  # fmt: skip
def test_mistakes_are_one_line(folder, monkeypatch, capsys, arguments, words):
    arguments = [one.replace("MAP", str(folder)) for one in arguments]
    code, stdout, stderr = called(monkeypatch, capsys, "localize", *arguments)
    assert (code, stdout) == (2, "")
    assert words in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize(("more", "words"), [
    (["candidates=4"], "was made with other candidates; name another folder"),
    (["features.max_keypoints=50"], "was made with other features"),
    (["candidates=all"], "candidates=all: a map matches so many"),
    (["retrieval.whiten=4"], "expected vlad, same or a network, without whiten"),
    (["scorer=paper"], "expected one score, as scorer=histogram, got several"),
    (["map=STREET"], "expected a new or empty folder, or a map"),
])  # fmt: skip
def test_other_settings_are_refused(folder, small_street, monkeypatch, capsys, more, words):
    more = [one.replace("STREET", str(small_street)) for one in more]
    code, _, stderr = built(folder, small_street, monkeypatch, capsys, *more)
    assert code == 2
    assert words in stderr


@pytest.mark.slow
def test_a_folder_is_watched(folder, small_street, tmp_path):
    asked = tmp_path / "asked"
    asked.mkdir()
    command = [sys.executable, "-m", "experiments.localize", f"map={folder}", f"images={asked}", "watch=true"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr.readline() == f"watching {asked}; end with Ctrl-C\n"
        for row in (3, 5):
            content = (small_street / f"database/{row:04d}.png").read_bytes()
            with (asked / f"{row}.png").open("wb") as file:
                file.write(content[:2000])
                file.flush()
                time.sleep(0.05)
                file.write(content[2000:])
            assert json.loads(running.stdout.readline())["place"] == f"{row:04d}.png"
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 130
