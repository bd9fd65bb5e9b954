"""Decoding and resampling as in Pillow, and errors of broken files."""

import os
import struct
import threading
import time
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mfvpr import InputError
from mfvpr.datasets import image_folder, read_image, resize
from mfvpr.datasets.image_reading import MAX_PIXELS, largest_16bit, read_size, shape_size
from mfvpr.utils.runtime import ordered_map
from tests.builders import read_golden
from tests.golden import make_resize
from tests.io.checks import one_line_error

pytestmark = pytest.mark.thorough


@pytest.fixture
def photo():
    return np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


@given(st.tuples(st.integers(40, 4000), st.integers(40, 4000)), st.integers(10**4, 10**6), st.sampled_from([1, 14, 32]))
def test_a_size_in_the_shape_of_an_image(shape, pixels, multiple):
    (width, height), aspect = shape_size(shape, pixels, multiple), shape[0] / shape[1]
    assert width % multiple == height % multiple == 0
    exact = np.sqrt([pixels * aspect, pixels / aspect])
    short, long = sorted((width, height))
    assert short == multiple or abs(short - exact.min()) <= multiple / 2
    assert abs(long - short * max(aspect, 1 / aspect)) <= multiple / 2  # the aspect ratio, within rounding
    assert shape_size(shape[::-1], pixels, multiple) == (height, width)


@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "P", "1", "LA"])
def test_every_mode_decodes_to_pillows_rgb(tmp_path, photo, mode):
    image = Image.fromarray(photo).convert(mode)
    path = tmp_path / ("a.tiff" if mode == "CMYK" else "a.png")
    image.save(path)
    with Image.open(path) as stored:
        np.testing.assert_array_equal(read_image(path), np.asarray(stored.convert("RGB")))
    assert read_image(path).shape == photo.shape


def png(photo):
    return cv2.imencode(".png", photo)[1].tobytes()


def write_bomb(path):
    """More pixels than are allowed, in a small file."""
    Image.new("1", (MAX_PIXELS // 8000 + 1, 8000)).save(path, format="PNG")


BROKEN = {
    "zero bytes": (lambda p, photo: p.write_bytes(b""), "cannot identify"),
    "text": (lambda p, photo: p.write_text("not an image"), "cannot be read"),
    "pipe": (lambda p, photo: os.mkfifo(p), "a pipe or device"),
    "truncated": (lambda p, photo: p.write_bytes(png(photo)[:-400]), "cannot be read"),
    "truncated JPEG": (lambda p, photo: p.write_bytes(cv2.imencode(".jpg", photo)[1].tobytes()[:-100]), "truncated"),
    "PostScript": (lambda p, photo: p.write_text("%!PS-Adobe-3.0\n%%BoundingBox: 0 0 9 9\n"), "cannot identify"),
    "GIF": (lambda p, photo: Image.fromarray(photo).save(p, format="GIF"), "cannot identify"),
    "too large": (lambda p, photo: write_bomb(p), "at most 64 megapixels"),
}


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files_are_errors_of_one_line(tmp_path, photo, kind, suffix):
    write, words = BROKEN[kind]
    path = tmp_path / f"bad{suffix}"
    write(path, photo)
    start = time.perf_counter()
    with one_line_error(words, str(path)):
        read_image(path)
    assert time.perf_counter() - start < 2.0  # nothing is decoded, and no pipe is waited for


@pytest.mark.parametrize("smooth", [False, True])
def test_a_damaged_png_is_an_error_or_has_the_same_pixels(tmp_path, photo, smooth):
    """Also in its tags behind the pixels, and where a decoder has enough pixels before it sees the damage."""
    path, photo = tmp_path / "a.png", np.zeros((30, 40, 3), np.uint8) + 90 if smooth else photo
    Image.fromarray(photo).save(path)
    write_orientation(path, 1, behind_pixels=True)
    content, errors = path.read_bytes(), []
    for place in range(0, len(content), 1 + len(content) // 100):
        for bits in (0xFF, 1):
            path.write_bytes(content[:place] + bytes([content[place] ^ bits]) + content[place + 1 :])
            try:
                pixels = read_image(path)
            except InputError as error:
                errors.append(str(error))
            else:
                np.testing.assert_array_equal(pixels, photo)
    assert len(errors) > 100
    assert all(error.startswith(f"{path}: ") for error in errors)


@pytest.mark.parametrize("size", [(336, 336), (20, 10), (60, 40)])
def test_resize_is_the_librarys(photo, size):
    pillow = Image.fromarray(photo)
    for kind, filter in (("pil_bilinear", Image.Resampling.BILINEAR), ("pil_bicubic", Image.Resampling.BICUBIC)):
        np.testing.assert_array_equal(resize(photo, size, kind), np.asarray(pillow.resize(size, filter)))
    for kind, flag in (("cv2_area", cv2.INTER_AREA), ("cv2_linear", cv2.INTER_LINEAR), ("cv2_cubic", cv2.INTER_CUBIC)):
        np.testing.assert_array_equal(resize(photo, size, kind), cv2.resize(photo, size, interpolation=flag))
    np.testing.assert_array_equal(resize(photo, size), resize(photo, size, "pil_bilinear"))
    with pytest.raises(InputError, match=r"^interpolation='linear': expected one of pil_bilinear, "):
        resize(photo, size, "linear")


@pytest.mark.parametrize(
    ("interpolation", "tolerance"),
    [
        ("pil_bicubic", 1),
        ("torch_bilinear", 1e-3),
        ("torch_no_antialias", 1e-3),
    ],
)
def test_resize_is_torchs(interpolation, tolerance):
    golden = read_golden("resize")[interpolation]
    resized = resize(make_resize.image(), make_resize.SIZE, interpolation)
    assert resized.dtype == golden.dtype
    difference = np.abs(resized.astype(float) - golden)
    assert difference.max() <= tolerance
    assert np.count_nonzero(difference >= 1) < 0.02 * golden.size


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


# A camera's stored image for an upright photo, by EXIF orientation.
STORED = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: image.transpose(1, 0, 2)[::-1],
    7: lambda image: image.transpose(1, 0, 2)[::-1, ::-1],
    8: lambda image: image.transpose(1, 0, 2)[:, ::-1],
}


def tag(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp", "a.jpg"])
@pytest.mark.parametrize("orientation", STORED)
def test_orientation_is_applied_unless_switched_off(tmp_path, orientation, name):
    photo = np.zeros((32, 48, 3), np.uint8)  # four colors in its corners: exact enough after JPEG, too
    photo[:16, :24], photo[:16, 24:], photo[16:, :24] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    stored = np.ascontiguousarray(STORED[orientation](photo))
    lossless = {"quality": 100, "subsampling": 0} if name == "a.jpg" else {"lossless": True} if "webp" in name else {}
    Image.fromarray(stored).save(tmp_path / name, exif=tag(orientation), **lossless)
    tolerance = 2 if name == "a.jpg" else 0
    np.testing.assert_allclose(read_image(tmp_path / name).astype(int), photo, atol=tolerance)
    np.testing.assert_allclose(read_image(tmp_path / name, orient=False).astype(int), stored, atol=tolerance)
    assert largest_16bit((tmp_path / name).read_bytes()) == 0
    assert read_size(tmp_path / name) == photo.shape[1::-1]
    assert read_size(tmp_path / name, orient=False) == stored.shape[1::-1]


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_orientation_of_16_bit_color(tmp_path, photo, name):
    path = tmp_path / name
    write_deep(path, np.ascontiguousarray(STORED[6](photo).astype(np.uint16) * 16))
    write_orientation(path, 6)
    np.testing.assert_array_equal(read_image(path, bits=12), photo)
    np.testing.assert_array_equal(read_image(path, bits=12, orient=False), STORED[6](photo))


def write_orientation(path, orientation, *, behind_pixels=False):
    """Put the tag into a file of 16-bit color, which Pillow cannot write."""
    content = path.read_bytes()
    if path.suffix == ".png":
        body = b"eXIf" + tag(orientation).tobytes().removeprefix(b"Exif\0\0")
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        place = len(content) - 12 if behind_pixels else 33  # before the last chunk, or behind the header's
        path.write_bytes(content[:place] + chunk + content[place:])
    else:
        (start,) = struct.unpack("<I", content[4:8])
        (count,) = struct.unpack("<H", content[start : start + 2])
        entries = [content[start + 2 + 12 * place :][:12] for place in range(count)]
        entries.append(struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0))
        entries.sort(key=lambda entry: struct.unpack("<H", entry[:2]))
        table = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
        path.write_bytes(content[:4] + struct.pack("<I", len(content)) + content[8:] + table)


@pytest.mark.parametrize("exif", [tag(0), tag(9), b"Exif\0\0garbage"], ids=["0", "9", "garbage"])
def test_an_orientation_without_meaning_is_none(tmp_path, photo, exif):
    Image.fromarray(photo).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), photo)


def write_deep(path, values):
    """A 16-bit file of gray `[H, W]` or color `[H, W, 3]`; big-endian TIFF as .tiff."""
    if path.suffix == ".tiff":
        Image.frombytes("I;16B", values.shape[::-1], values.astype(">u2").tobytes()).save(path)
    elif path.suffix == ".pgm":
        path.write_bytes(b"P5 %d %d 65535\n" % values.shape[::-1] + values.astype(">u2").tobytes())
    else:
        path.write_bytes(np.asarray(cv2.imencode(path.suffix, values[..., ::-1] if values.ndim == 3 else values)[1]))


@pytest.mark.parametrize("factor", [256, 257])
@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.tiff", "a.pgm"])
def test_16_bit_copies_are_their_originals(tmp_path, photo, name, factor):
    path, gray = tmp_path / name, photo[..., 0]
    for values in (gray, photo) if name in ("a.png", "a.tif") else (gray,):
        write_deep(path, values.astype(np.uint16) * factor)
        original = photo if values.ndim == 3 else np.repeat(gray[..., None], 3, axis=2)
        np.testing.assert_array_equal(read_image(path), original)
        largest = 0 if name == "a.pgm" else factor * int(values.max())
        assert largest_16bit(path.read_bytes()) == largest


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_bits_in_use_are_a_choice(tmp_path, photo, name):
    """Cameras of 12 bits write files of 16."""
    path, twelve = tmp_path / name, photo.astype(np.uint16) * 16 + 7
    for values in (twelve[..., 0], twelve):
        write_deep(path, values)
        original = photo if values.ndim == 3 else np.repeat(photo[..., :1], 3, axis=2)
        np.testing.assert_array_equal(read_image(path, bits=12), original)
        np.testing.assert_array_equal(read_image(path), original // 16)
        np.testing.assert_array_equal(read_image(path, bits=8), np.minimum(np.int32(16) * original + 7, 255))
        with Image.open(path) as image:
            np.testing.assert_array_equal(read_image(path, bits=None), np.asarray(image.convert("RGB")))


def test_netpbm_files_state_their_range(tmp_path):
    gray = np.array([[0, 1000, 4095]], ">u2")
    (tmp_path / "a.pgm").write_bytes(b"P5 3 1 4095\n" + gray.tobytes())
    (tmp_path / "a.ppm").write_bytes(b"P6 3 1 4095\n" + np.repeat(gray.ravel(), 3).tobytes())
    for bits in (12, 16):
        for name in ("a.pgm", "a.ppm"):
            np.testing.assert_array_equal(read_image(tmp_path / name, bits=bits)[0, :, 0], [0, 62, 255])


@pytest.mark.parametrize("dtype", [np.int32, np.float32])
def test_32_bits_have_no_range(tmp_path, dtype):
    path = tmp_path / "a.tif"
    Image.fromarray(np.array([[0, 300]], dtype)).save(path)
    with pytest.raises(InputError, match=r"a\.tif: .*8 or 16 bits .*got 32"):
        read_image(path)
    np.testing.assert_array_equal(read_image(path, bits=None)[0, :, 0], [0, 255])


@pytest.mark.parametrize("bits", [0, 7, 17])
def test_bits_beyond_8_to_16_are_refused(tmp_path, bits):
    with pytest.raises(InputError, match="expected from 8 to 16 bits"):
        image_folder(tmp_path, bits=bits)
