"""Read and resize images: files, also frames of videos -> RGB arrays `[H, W, 3]`.

Decoding and the default resampling are Pillow's, as in the published networks' code. In addition, images are turned by
their EXIF orientation, and 16 bits a channel are reduced to the upper 8.
"""

import math
import struct
import warnings
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Num, UInt8
from PIL import Image, ImageFile

from mfvpr.io.containers import reading
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import require_file

MAX_PIXELS = 64_000_000
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "PPM", "BMP")  # Pillow's names; it runs Ghostscript for others
VIDEO_SUFFIXES = frozenset({".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"})

Interpolation = Literal[
    "pil_bilinear", "pil_bicubic", "cv2_linear", "cv2_area", "cv2_cubic", "torch_bilinear", "torch_no_antialias"
]
Pixels = UInt8[np.ndarray, "height width 3"]
Ignored = Bool[np.ndarray, "height width"]
_PIL = {"pil_bilinear": Image.Resampling.BILINEAR, "pil_bicubic": Image.Resampling.BICUBIC}
_CV2 = {"cv2_linear": cv2.INTER_LINEAR, "cv2_area": cv2.INTER_AREA, "cv2_cubic": cv2.INTER_CUBIC}
_GRAY, _COLOR = ("I", "I;16", "I;16L", "I;16B", "I;16N"), ("RGB", "RGBA", "LA")  # Pillow's modes of 16-bit files
_ORIENTATION = 0x0112
_TURNS = "FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE ROTATE_90"
_TURN = {orientation: Image.Transpose[name] for orientation, name in enumerate(_TURNS.split(), start=2)}
_INVERSE = {6: 8, 8: 6}  # all others are their own inverse

# Pillow warns from 89 megapixels on; `read_image` refuses earlier, with the file's name.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
warnings.filterwarnings("ignore", message="Palette images with Transparency")


def read_image(path: Path | str, *, orient: bool = True, bits: int | None = 16) -> Pixels:
    """Read the image file `path` as RGB.

        image = mfvpr.datasets.read_image("query.jpg")  # [H, W, 3] uint8

    Args:
        orient: turn the image by its EXIF orientation.
        bits: number of bits in use in 16-bit gray and color files (12-bit cameras write 16 bits as well), of which the
            upper 8 are kept; Netpbm files state their largest value, which is used instead. None = Pillow's
            conversion: gray is cut off at 255, of color the upper 8 of 16 bits are kept.

    Raises:
        InputError: not an image file of a format in `FORMATS`, damaged (only PNG has checksums), over 64 megapixels
            (checked before decoding), or of 32 bits a channel, whose range is unknown (unless `bits` is None).
    """
    path = Path(path)
    with reading(path, "an image file", "replace or remove it"), open_image(path) as image:
        if image.width * image.height > MAX_PIXELS:
            limit = f"at most {MAX_PIXELS // 10**6} megapixels"
            raise InputError(f"expected {limit}, got {image.width} x {image.height} px; shrink the image")
        used = _bits_in_use(image, bits)
        if used is None and bits is not None and image.mode in ("I", "F"):
            raise InputError("expected 8 or 16 bits a channel, got 32, of unknown range; convert it")
        orientation, is_turned = _orientation(image), image.format == "TIFF"  # Pillow and OpenCV turn these
        is_color = image.mode not in _GRAY
        if used is None or (is_color and used == 16):  # Pillow takes the upper 8 of 16 bits of color
            rgb = image.convert("RGB")
        elif is_color and image.mode not in _COLOR:
            raise ValueError(f"its 16 bits a channel are {image.mode}, not gray or RGB")
        else:
            values = _color_values(np.fromfile(path, np.uint8)) if is_color else np.asarray(image)
            upper = np.clip(values.astype(np.int32), 0, 2**used - 1) >> (used - 8)
            rgb = Image.fromarray(upper.astype(np.uint8)).convert("RGB")
        if bool(orient) == is_turned:
            return np.asarray(rgb)
        turn = _INVERSE.get(orientation, orientation) if is_turned else orientation
        return np.asarray(rgb.transpose(_TURN[turn]) if turn in _TURN else rgb)


def fill_ignored(image: Pixels, mask: Path, *, orient: bool = True) -> tuple[Pixels, Ignored]:
    """Fill pixels that a mask ignores with the mean color of the other pixels; also return which pixels these are.

    A mask is an image file of the image's shape, of any size, black (below 128) where pixels are ignored. Errors are
    those of `read_image`; also an `InputError` if the mask has another shape, or ignores the whole image.
    """
    brightness, (width, height) = Image.fromarray(read_image(mask, orient=orient)).convert("L"), image.shape[1::-1]
    if not 0.97 < brightness.width * height / (brightness.height * width) < 1.03:
        got = f"{brightness.width} x {brightness.height}; scale or turn it"
        raise InputError(
            f"{mask}: expected a mask in the shape of its image, {width} x {height}, got {got}; scale or turn it"
        )
    ignored = np.asarray(brightness.resize(image.shape[1::-1], Image.Resampling.NEAREST)) < 128
    if ignored.all():
        expected = "a mask with pixels of 128 or more, which are used"
        raise InputError(f"{mask}: expected {expected}, got one that ignores the whole image; write them as 255")
    mean = np.rint(image[~ignored].mean(axis=0)).astype(np.uint8)
    return np.where(ignored[..., None], mean, image), ignored


def read_size(path: Path | str, *, orient: bool = True) -> tuple[int, int]:
    """(width, height) px of the image that `read_image` reads, from the header of the file; errors as there."""
    with reading(Path(path), "an image file", "replace or remove it"), open_image(path) as image:
        width, height = image.size
        is_stored = image.format != "TIFF"  # already turned by Pillow
        return (height, width) if orient is is_stored and _orientation(image) >= 5 else (width, height)


def open_image(file: Path | str | BinaryIO) -> ImageFile.ImageFile:
    """Open an image file of a format in `FORMATS` with Pillow, whose errors have no common class."""
    with Image.open(file, formats=FORMATS) as image:
        if image.format == "PNG":  # decoding alone misses damage that leaves enough pixels
            image.verify()
    return Image.open(file, formats=FORMATS)


def shape_size(shape: tuple[int, int], pixels: float, multiple: int = 1) -> tuple[int, int]:
    """(width, height) px of about `pixels` in all, in the shape of an image of `shape` (width, height).

    Both sides are a `multiple`: the shorter one is rounded, then the longer one in its proportion.
    """
    short, long = sorted(shape)
    rounded = multiple * max(1, round(math.sqrt(pixels * short / long) / multiple))
    longer = multiple * round(rounded * long / short / multiple)
    return (longer, rounded) if shape[0] > shape[1] else (rounded, longer)


def largest_16bit(content: bytes) -> int:
    """Largest value of an image file of 16 bits a channel; 0 for others, and for files that state their range."""
    try:
        with open_image(BytesIO(content)) as image:
            states_range = image.format == "PPM" or image.width * image.height > MAX_PIXELS
            if states_range or _bits_in_use(image, 16) != 16:
                return 0
            is_gray = image.mode in _GRAY
            return int((np.asarray(image) if is_gray else _color_values(np.frombuffer(content, np.uint8))).max())
    except Exception:  # decoders share no class of errors, and reading the image raises an InputError
        return 0


def resize(
    image: UInt8[np.ndarray, "_ _ 3"], size: tuple[int, int], interpolation: Interpolation = "pil_bilinear"
) -> Num[np.ndarray, "height width 3"]:
    """Resize an image to `size` (width, height) without crop; pixel centers are at half pixels.

        mfvpr.datasets.resize(image, (640, 480), "cv2_area")  # [H, W, 3]

    | interpolation | as | result |
    | :-- | :-- | :-- |
    | `pil_bilinear`, `pil_bicubic` | Pillow, antialiased; as torch's of uint8, up to a level in 1 % of values | uint8 |
    | `cv2_linear`, `cv2_area`, `cv2_cubic` | OpenCV; only `cv2_area` is antialiased | uint8 |
    | `torch_bilinear` | torch's antialiasing of floats, not rounded | float32, 0 .. 255 |
    | `torch_no_antialias` | torch's bilinear of floats as it was up to 2022, not rounded | float32, 0 .. 255 |
    """
    require_word("interpolation", interpolation, Interpolation)
    if interpolation == "torch_bilinear":  # Pillow's kernel is torch's, and its float images are not rounded
        channels = (Image.fromarray(channel) for channel in np.moveaxis(image.astype(np.float32), -1, 0))
        return np.stack([np.asarray(channel.resize(size, Image.Resampling.BILINEAR)) for channel in channels], axis=-1)
    if interpolation == "torch_no_antialias":
        return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    if interpolation in _PIL:
        return np.asarray(Image.fromarray(image).resize(size, _PIL[interpolation]))
    return np.asarray(cv2.resize(image, size, interpolation=_CV2[interpolation]))


def read_frames(path: Path | str, *, every: int = 1) -> Iterator[tuple[int, np.ndarray]]:
    """Read (number from 0, image `[H, W, 3]` uint8 RGB) of every `every`-th frame; an InputError if there are none."""
    path = Path(path)
    require_file(path, "a video file")
    video, number = cv2.VideoCapture(str(path)), 0
    try:
        while video.grab():
            if number % every == 0:
                is_valid, image = video.retrieve()
                if is_valid:
                    yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            number += 1
    finally:
        video.release()
    if not number:
        raise InputError(f"{path}: expected a video, got a file without frames that can be read; convert it")


def _orientation(image: Image.Image) -> int:
    if image.format == "PNG":
        image.load()  # tags may follow the pixels
    try:
        value = image.getexif().get(_ORIENTATION, 1)
    except (SyntaxError, ValueError, LookupError, TypeError, struct.error):  # an image with damaged tags is readable
        return 1
    return value if value in _TURN else 1


def _bits_in_use(image: ImageFile.ImageFile, bits: int | None) -> int | None:
    """Bits in use of 16 bits a channel; None = Pillow's conversion applies. Call it before the image is decoded."""
    if bits is None or not image.tile:
        return None
    tile = image.tile[0]
    raw = tile.args[0] if isinstance(tile.args, tuple) else tile.args or image.mode
    if image.format == "PPM":
        return 16 if image.mode == "I" else None  # gray; Pillow scales it to all 16 bits, and color to 8
    if raw == "I;12":
        return 12
    return bits if ";16" in raw else None


def _color_values(content: np.ndarray) -> np.ndarray:
    """Decode to `[H, W, 3]` uint16 RGB with OpenCV, because Pillow drops the lower 8 bits."""
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 3:
        raise ValueError("its 16 bits of color cannot be decoded")
    return image[..., 2::-1]
