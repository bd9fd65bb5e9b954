"""Decoding and resampling: what Pillow gives, and what every broken file is told."""

import os
import threading
import time

import cv2
import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError
from mfvpr.data.images import MAX_PIXELS, ordered_map, read_image, resize
from tests.golden import make_resize


@pytest.fixture
def photo():
    return np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize("name", ["a.png", "with space.png", "ünïcode-é-日本.png", "@1@2@.png", "x.bmp", "x.tiff"])
def test_lossless_files_come_back(tmp_path, photo, name):
    Image.fromarray(photo).save(tmp_path / name)
    np.testing.assert_array_equal(read_image(tmp_path / name), photo)


@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "P", "1", "I;16", "LA"])
def test_every_mode_decodes_to_pillows_rgb(tmp_path, photo, mode):
    image = (
        Image.fromarray(photo).convert("L").convert("I;16") if mode == "I;16" else Image.fromarray(photo).convert(mode)
    )
    path = tmp_path / ("a.tiff" if mode == "CMYK" else "a.png")
    image.save(path)
    with Image.open(path) as stored:
        np.testing.assert_array_equal(read_image(path), np.asarray(stored.convert("RGB")))
    assert read_image(path).shape == photo.shape


def _broken(path, photo):
    Image.fromarray(photo).save(path)
    return path


def _bomb(path):
    Image.new("1", (MAX_PIXELS // 8000 + 1, 8000)).save(path, format="PNG")  # quick to write, whatever its name says


BAD = {
    "zero bytes": (lambda p, photo: p.write_bytes(b""), "0 bytes"),
    "text": (lambda p, photo: p.write_text("not an image"), "cannot be read"),
    "directory": (lambda p, photo: p.mkdir(), "got a directory"),
    "pipe": (lambda p, photo: os.mkfifo(p), "a device or pipe"),
    "device": (lambda p, photo: p.symlink_to("/dev/zero"), "a device or pipe"),
    "dangling link": (lambda p, photo: p.symlink_to("nowhere"), "cannot be opened"),
    "truncated": (lambda p, photo: p.write_bytes(_broken(p, photo).read_bytes()[:-400]), "cannot be read"),
    "flipped bytes": (
        lambda p, photo: p.write_bytes(_broken(p, photo).read_bytes()[:60] + os.urandom(99)),
        "cannot be",
    ),
    "too large": (lambda p, photo: _bomb(p), "at most 64 megapixels"),
}


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kind", BAD)
def test_broken_files_are_named_in_one_line(tmp_path, photo, kind, suffix):
    make, words = BAD[kind]
    path = tmp_path / f"bad{suffix}"
    make(path, photo)
    start = time.perf_counter()
    with pytest.raises(InputError, match=words) as caught:
        read_image(path)
    assert time.perf_counter() - start < 2.0  # nothing is decoded, and no pipe is waited for
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [(336, 336), (20, 10), (60, 40)])
def test_resize_is_the_librarys_own(photo, size):
    pillow = Image.fromarray(photo)
    bilinear, bicubic = Image.Resampling.BILINEAR, Image.Resampling.BICUBIC
    np.testing.assert_array_equal(resize(photo, size), np.asarray(pillow.resize(size, bilinear)))
    np.testing.assert_array_equal(resize(photo, size, "pil_bicubic"), np.asarray(pillow.resize(size, bicubic)))
    np.testing.assert_array_equal(
        resize(photo, size, "cv2_area"), cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    )
    assert resize(photo, size, "cv2_linear").shape == (size[1], size[0], 3)


@pytest.mark.parametrize(("interpolation", "tolerance"), [("pil_bicubic", 1), ("torch_bilinear", 1e-3)])
def test_resize_is_torchs(interpolation, tolerance):
    golden = np.load(make_resize.GOLDEN)[interpolation]
    resized = resize(make_resize.image(), make_resize.SIZE, interpolation)
    assert resized.dtype == golden.dtype
    difference = np.abs(resized.astype(float) - golden)
    assert difference.max() <= tolerance
    assert np.count_nonzero(difference >= 1) < 0.02 * golden.size


def test_resize_without_rounding_keeps_order_and_range(photo):
    exact, rounded = resize(photo, (20, 10), "torch_bilinear"), resize(photo, (20, 10), "pil_bilinear")
    assert exact.shape == rounded.shape
    assert np.abs(exact - rounded).max() <= 1  # Pillow rounds between the axes as well
    np.testing.assert_array_equal(resize(photo, (60, 40), "torch_bilinear"), photo)


def test_ordered_map_keeps_order_and_never_runs_far_ahead():
    started, lock = [], threading.Lock()

    def work(item):
        with lock:
            started.append(item)
        time.sleep(0.001 * (item % 3))
        return item * item

    results = ordered_map(work, range(200), workers=3)
    assert [next(results) for _ in range(3)] == [0, 1, 4]
    time.sleep(0.1)
    assert len(started) <= 3 + 2 * 3 + 1
    assert list(results) == [i * i for i in range(3, 200)]


def test_ordered_map_passes_errors_on():
    with pytest.raises(ZeroDivisionError):
        list(ordered_map(lambda x: 1 / x, [1, 0, 2], workers=2))


def test_orientation_tags_are_left_alone_as_by_pillow(tmp_path, photo):
    exif = Image.Exif()
    exif[0x0112] = 6  # to be shown rotated by 90 degrees
    Image.fromarray(photo).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), photo)


def test_16_bits_are_what_pillow_makes_of_them(tmp_path):
    deep = np.array([[0, 100, 255, 256, 40_000]], np.uint16)
    Image.fromarray(deep).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[..., 0], [[0, 100, 255, 255, 255]])


def test_an_image_of_one_pixel_fills_any_size(tmp_path):
    Image.new("RGB", (1, 1), (10, 20, 30)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(resize(read_image(tmp_path / "a.png"), (8, 4)), np.full((4, 8, 3), (10, 20, 30)))
