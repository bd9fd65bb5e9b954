"""Fingerprints of image files: content decides, and no file is read twice without a reason."""

import hashlib
import os
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mfvpr.datasets import contents as module
from mfvpr.datasets import image_folder
from mfvpr.datasets.contents import Content, contents

SETTLED = 30_000_000  # ns; the real one would keep every test waiting for seconds


@pytest.fixture(autouse=True)
def quickly_settled(monkeypatch):
    monkeypatch.setattr(module, "SETTLED", SETTLED)


def settle():
    time.sleep(2 * SETTLED / 1e9)


@pytest.fixture
def folder(tmp_path):
    folder, rng = tmp_path / "images", np.random.default_rng(0)
    folder.mkdir()
    for row in range(3):
        Image.fromarray(rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)).save(folder / f"{row}.png")
    return folder


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


def fingerprint(folder, cache=None):
    return contents(image_folder(folder), cache).fingerprint


def record(cache):
    (path,) = cache.iterdir()
    return path


def test_the_fingerprint_follows_names_contents_and_order(tmp_path, folder):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    digest = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    before = fingerprint(folder)
    assert before == fingerprint(other) == digest.hexdigest()[:16]
    (other / "1.png").rename(other / "9.png")
    assert fingerprint(other) != before
    (folder / "1.png").write_bytes(b"other")
    assert fingerprint(folder) != before


def test_a_second_run_reads_no_image_whichever_part_of_the_folder_it_takes(folder, cache, monkeypatch):
    images = image_folder(folder)
    parts = [replace(images, names=names) for names in (images.names[:1], images.names[1:])]
    settle()
    first = [*(contents(part, cache) for part in parts), contents(images)]
    monkeypatch.setattr(module, "read_content", lambda path: pytest.fail(f"{path} read again"))
    assert [contents(part, cache) for part in (*parts, images)] == first


def test_content_decides_whatever_times_and_names_say(tmp_path, folder, cache):
    settle()
    first = fingerprint(folder, cache)
    path, times = folder / "1.png", (folder / "1.png").stat()
    os.utime(path)  # other times, same content
    settle()
    assert fingerprint(folder, cache) == first

    content = path.read_bytes()
    changed = content[:-20] + bytes(20)
    for stamp in (None, (times.st_atime_ns, times.st_mtime_ns)):  # same size; then the same time as well
        path.write_bytes(changed)
        if stamp:
            os.utime(path, ns=stamp)
        assert fingerprint(folder, cache) == fingerprint(folder) != first
        path.write_bytes(content)
        assert fingerprint(folder, cache) == first
        settle()
        assert fingerprint(folder, cache) == first

    shutil.copytree(folder, tmp_path / "copy")
    assert fingerprint(tmp_path / "copy", cache) == first


def test_what_has_just_been_written_is_not_trusted(folder, cache, monkeypatch):
    """It may be written again within the same tick of the clock, with the same times."""
    monkeypatch.setattr(module, "SETTLED", 10**12)
    os.utime(folder / "0.png", (0, 0))  # a copied file keeps an old time
    fingerprint(folder, cache)
    assert not any(name in record(cache).read_text() for name in ("0.png", "1.png"))
    monkeypatch.setattr(module, "SETTLED", SETTLED)
    settle()
    fingerprint(folder, cache)
    assert all(name in record(cache).read_text() for name in ("0.png", "1.png", "2.png"))


def test_damaged_records_cost_time_only(folder, cache):
    settle()
    first = fingerprint(folder, cache)
    intact = record(cache).read_bytes()
    for damaged in (b"", intact[: len(intact) // 2], b"\xff" + intact):
        record(cache).write_bytes(damaged)
        assert fingerprint(folder, cache) == first
        assert record(cache).read_bytes() == intact


def test_files_that_cannot_be_read_are_left_to_whoever_reads_images(folder, cache):
    (folder / "3.png").symlink_to("nowhere")
    os.mkfifo(folder / "4.png")
    (folder / "5.png").write_bytes(b"no image")
    settle()
    for _ in range(2):
        files = contents(image_folder(folder), cache).files
        assert files[3:5] == (Content(), Content())
        assert files[5] == Content(hashlib.sha256(b"no image").hexdigest())


def test_how_images_are_read_is_part_of_the_fingerprint(folder, cache):
    Image.fromarray(np.array([[7, 4095]], np.uint16)).save(folder / "4.png")
    settle()
    first, second = (contents(image_folder(folder), cache) for _ in range(2))
    assert first.files == second.files
    assert [file.largest for file in first.files] == [0, 0, 0, 4095]
    ways = [
        contents(image_folder(folder, orient=orient, bits=bits), cache)
        for orient in (True, False)
        for bits in (16, 12, None)
    ]
    assert len({way.fingerprint for way in ways}) == 6
