"""Times of images in nanoseconds, from names of files and from lists; no time is rounded to a float."""

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path, PurePosixPath

from mfvpr.io.containers import reading, shorten
from mfvpr.utils.errors import InputError

SECOND = 10**9  # nanoseconds
_END = 2**31  # seconds, of ROS; a larger number has another unit
_DIGITS = (13, 16, 19)  # of whole numbers of ms, us and ns since 1970
_NUMBER = re.compile(r"[0-9]+(\.[0-9]*)?([eE][-+]?[0-9]{1,3})?")
_NAME = re.compile(r"[0-9]+\.[0-9]+|[1-9][0-9]{9}([0-9]{3}){0,3}")  # a frame number is no time


def parse_stamp(text: str) -> int:
    """Nanoseconds of a time in seconds, or in ms, us or ns since 1970 if it is a whole number of 13, 16 or 19 digits.

        parse_stamp("1305031102.175304")  # 1305031102175304000

    More than 9 decimals of seconds are rounded. A `ValueError` if it is no time before 2038.
    """
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"not a time: {text!r}")
    scale = len(text) - 10 if len(text) in _DIGITS and text.isdigit() and text[0] != "0" else 0
    seconds = Decimal(text).scaleb(-scale)
    if seconds >= _END:
        raise ValueError(f"a time after 2038: {text!r}")
    return int(seconds.scaleb(9).to_integral_value())


def stamps_in_names(names: Sequence[str]) -> list[int]:
    """Times of images in ns, which are the names of their files, as `parse_stamp` reads them.

        stamps_in_names(["cam0/1403636579763555584.png", "rgb/12.345.png"])  # [1403636579763555584, 12345000000]

    A whole number with fewer than 10 digits, or with a 0 at its beginning, is an `InputError`: it numbers the frames.
    """
    stems = [PurePosixPath(name).stem for name in names]
    for name, stem in zip(names, stems, strict=True):
        if not _NAME.fullmatch(stem):
            raise InputError(
                f"{shorten(name)}: expected the time as the name of the file, such as 1403636579763555584.png (ns) or "
                "12.345.png (s); rename the images, or give a file of times (read_stamps, or --times FILE)"
            )
    return [parse_line_stamp(shorten(name), stem) for name, stem in zip(names, stems, strict=True)]


def read_stamps(path: Path | str, num_images: int) -> list[int]:
    """Times of images in ns from a text file: a line for each image, as `parse_stamp` reads it; # begins a comment."""
    path = Path(path)
    stamps = [parse_line_stamp(where, line) for where, line in read_content_lines(path, "a text file of times")]
    if len(stamps) != num_images:
        raise InputError(f"{path}: expected times of {num_images} images, a line for each, got {len(stamps)}")
    return stamps


def read_content_lines(path: Path, kind: str) -> list[tuple[str, str]]:
    """Lines without spaces around them, each with its place for messages; no empty lines, no comments after #."""
    with reading(path, mend=f"expected {kind}"):
        text = path.read_text(encoding="utf-8-sig")
    lines = ((f"{path}: line {number}", line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [(where, line) for where, line in lines if line and not line.startswith("#")]


def parse_line_stamp(where: str, text: str) -> int:
    """`parse_stamp` with an InputError that begins with the place of the text."""
    try:
        return parse_stamp(text)
    except ValueError:
        expected = "a time in s, or a whole number of ms, us or ns since 1970"
        raise InputError(f"{where}: expected {expected}, got {shorten(text)!r}") from None
