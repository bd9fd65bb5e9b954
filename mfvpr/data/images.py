"""Image files -> RGB arrays `[H, W, 3]` of a stated size (width, height) in pixels.

Decoding and the default resampling are Pillow's, which the published networks were fed with.
"""

import itertools
import stat
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from PIL import Image

from mfvpr.errors import InputError

MAX_PIXELS = 64_000_000
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})

Interpolation = Literal["pil_bilinear", "pil_bicubic", "cv2_linear", "cv2_area", "torch_bilinear"]
_PIL = {"pil_bilinear": Image.Resampling.BILINEAR, "pil_bicubic": Image.Resampling.BICUBIC}
_CV2 = {"cv2_linear": cv2.INTER_LINEAR, "cv2_area": cv2.INTER_AREA}

# Pillow warns from 89 megapixels on; `read_image` refuses earlier, with the file's name.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
warnings.filterwarnings("ignore", message="Palette images with Transparency")

Item = TypeVar("Item")
Result = TypeVar("Result")


def read_image(path: Path | str) -> np.ndarray:
    """`[H, W, 3]` uint8 RGB.

    Raises:
        InputError: not a regular file, empty, not an image, truncated, or over 64 megapixels (refused from the
            header, before anything is decoded).
    """
    path = Path(path)
    _check_file(path)
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(_too_large(path, f"{image.width} x {image.height} px"))
            return np.asarray(image.convert("RGB"))
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(_too_large(path, "several times as many")) from None
    except (
        Exception
    ) as error:  # decoders raise whatever a broken file leads them to: OSError, SyntaxError, struct.error
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read as an image ({reason}); replace or remove it") from None


def resize(image: np.ndarray, size: tuple[int, int], interpolation: Interpolation = "pil_bilinear") -> np.ndarray:
    """`image` `[H, W, 3]` uint8 squashed to `size` (width, height), no crop, aspect not kept. Half-pixel centers.

    | interpolation | as | result |
    | :-- | :-- | :-- |
    | `pil_bilinear`, `pil_bicubic` | Pillow, antialiased; torch's of uint8, but for a level in 1 % of values | uint8 |
    | `cv2_linear`, `cv2_area` | OpenCV; `cv2_linear` is not antialiased | uint8 |
    | `torch_bilinear` | torch's antialiasing of floats, not rounded | float32, 0 .. 255 |

    Networks take both types; SIFT refuses floats.
    """
    if interpolation == "torch_bilinear":
        return _resized_in_float(image, size)
    if interpolation in _PIL:
        return np.asarray(Image.fromarray(image).resize(size, _PIL[interpolation]))
    return np.asarray(cv2.resize(image, size, interpolation=_CV2[interpolation]))


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], *, workers: int) -> Iterator[Result]:
    """`map` on threads, results in order, at most 2 x `workers` of them waiting.

    Decoding and resampling release the interpreter lock, so this overlaps them with whatever consumes the results.
    """
    remaining = iter(items)
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Result]] = deque(
            pool.submit(function, item) for item in itertools.islice(remaining, 2 * workers)
        )
        try:
            while waiting:
                result = waiting.popleft().result()
                for item in itertools.islice(remaining, 1):
                    waiting.append(pool.submit(function, item))
                yield result
        finally:
            for future in waiting:
                future.cancel()


def _resized_in_float(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bilinear, antialiased, `[H, W, 3]` float32: Pillow's kernel is torch's, and its float images are not rounded."""
    channels = (Image.fromarray(channel) for channel in np.moveaxis(image.astype(np.float32), -1, 0))
    return np.stack([np.asarray(channel.resize(size, Image.Resampling.BILINEAR)) for channel in channels], axis=-1)


def _check_file(path: Path) -> None:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror}); check the path and its permissions") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "a device or pipe"
        raise InputError(f"{path}: expected an image file, got {kind}; rename or remove it")
    if status.st_size == 0:
        raise InputError(f"{path}: expected an image file, got 0 bytes; replace or remove it")


def _too_large(path: Path, size: str) -> str:
    return f"{path}: expected at most {MAX_PIXELS // 10**6} megapixels, got {size}; shrink the image"
