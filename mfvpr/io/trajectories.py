"""Times (whole nanoseconds) and poses of images in text files of TUM and KITTI, and trajectories of images."""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path, PurePosixPath

from mfvpr.io.containers import parse_number, reading, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable, write_text

SECOND = 10**9  # nanoseconds
_END = Decimal(2**31)  # seconds, of ROS; a larger number has another unit
_UNITS = {13: -3, 16: -6, 19: -9}  # digits of whole numbers of ms, us and ns since 1970 -> power of ten
_NUMBER = re.compile(r"[0-9]+(\.[0-9]*)?([eE][-+]?[0-9]{1,3})?")
_NAME = re.compile(r"[0-9]+\.[0-9]+|[1-9][0-9]{9}([0-9]{3}){0,3}")  # a frame number is no time
_TUM, _KITTI = 7, 12  # numbers of a pose
_LARGEST_GAP = SECOND // 100  # between an image and its pose, as evo allows


def parse_stamp(text: str, where: str = "time") -> int:
    """Nanoseconds of a time in seconds, or in ms, us or ns since 1970 if it is a whole number of 13, 16 or 19 digits.

        parse_stamp("1305031102.175304")  # 1305031102175304000

    More than 9 decimals of seconds are rounded. An `InputError` that begins with `where` if it is no time before 2038.
    """
    power = _UNITS.get(len(text), 0) if text.isdigit() and text[0] != "0" else 0
    seconds = Decimal(text).scaleb(power) if _NUMBER.fullmatch(text) else _END
    if seconds >= _END:
        expected = "a time in s, or a whole number of ms, us or ns since 1970"
        raise InputError(f"{where}: expected {expected}, got {shorten(text)!r}")
    return int(seconds.scaleb(9).to_integral_value())


def stamps_in_names(names: Sequence[str]) -> list[int]:
    """Times of images in ns, which are the names of their files, as `parse_stamp` reads them.

        stamps_in_names(["cam0/1403636579763555584.png", "rgb/12.345.png"])  # [1403636579763555584, 12345000000]

    A whole number with fewer than 10 digits, or with a 0 at its beginning, is an `InputError`: it numbers the frames.
    """
    for name in names:
        if not _NAME.fullmatch(PurePosixPath(name).stem):
            expected = "the time as the name of the file, such as 1403636579763555584.png (ns) or 12.345.png (s)"
            raise InputError(f"{shorten(name)}: expected {expected}; rename the images, or give a file of times")
    return [parse_stamp(PurePosixPath(name).stem, shorten(name)) for name in names]


def read_stamps(path: Path | str, num_images: int) -> list[int]:
    """Times of images in ns from a text file: a line for each image, as `parse_stamp` reads it; # begins a comment."""
    path = Path(path)
    stamps = [parse_stamp(line, where) for where, line in _lines(path, "a text file of times")]
    if len(stamps) != num_images:
        raise InputError(f"{path}: expected times of {num_images} images, a line for each, got {len(stamps)}")
    return stamps


def read_poses(path: Path | str, names: Sequence[str]) -> list[str]:
    """Poses of images, `[M]` texts of 7 or 12 numbers with a space between them, digit for digit as in the file.

    Args:
        path: TUM, lines `timestamp tx ty tz qx qy qz qw`, or KITTI, lines of 12 numbers: the first three rows of the
            pose's matrix. # begins a comment. A line for each image, in the order of `names`.
        names: `[M]` relative POSIX paths in natural order. If they are times, as `stamps_in_names` reads them, TUM's
            timestamps must be the same within 10 ms.

    Raises:
        InputError: other numbers, timestamps that do not ascend or differ from the images', or not M poses.
    """
    path = Path(path)
    lines = [(where, line.split()) for where, line in _lines(path, "a text file of poses")]
    if len(lines) != len(names):
        raise InputError(f"{path}: expected a pose of each of the {len(names)} images, got {len(lines)}")
    image_stamps = None
    with suppress(InputError):  # names that are no times
        image_stamps = stamps_in_names(names)
    poses, before = [], -1
    for row, (where, words) in enumerate(lines):
        try:
            is_finite = all(math.isfinite(parse_number(word)) for word in words)
        except ValueError:
            is_finite = False
        if not is_finite or len(words) != len(lines[0][1]) or len(words) not in (1 + _TUM, _KITTI):
            expected = "8 (TUM) or 12 (KITTI) finite numbers in all lines"
            raise InputError(f"{where}: expected {expected}, got {shorten(' '.join(words))!r}")
        if len(words) != _KITTI:
            stamp, words = parse_stamp(words[0], where), words[1:]
            if stamp <= before:
                got = f"{_seconds(stamp)} after {_seconds(before)}"
                raise InputError(f"{where}: expected ascending timestamps, got {got}; sort the lines by time")
            if image_stamps is not None and abs(stamp - image_stamps[row]) > _LARGEST_GAP:
                expected = f"the time of {shorten(names[row])} within 10 ms"
                raise InputError(f"{where}: expected {expected}, got {_seconds(stamp)}")
            before = stamp
        poses.append(" ".join(words))
    return poses


def write_trajectory(path: Path | str, poses: Sequence[str | None], stamps: Sequence[int] | None = None) -> None:
    """Write the poses of localized images to a new text file, atomically, digit for digit.

    Args:
        poses: `[Q]` texts of 7 numbers (TUM) or 12 (KITTI), as `read_poses` returns them; None = no place, which a
            frame of KITTI must have.
        stamps: `[Q]` different times in ns, for TUM, whose lines are in their order; None for KITTI.

    Raises:
        InputError: the file exists, poses are missing or have other numbers, or two images have the same time.
    """
    path = Path(path)
    places = [pose for pose in poses if pose is not None]
    if not places or (stamps is None and len(places) < len(poses)):
        expected = "a place of all images, or for TUM of at least one"
        raise InputError(f"{path}: expected {expected}, got {len(places)} places of {len(poses)} images")
    num_numbers = _KITTI if stamps is None else _TUM
    if any(len(pose.split()) != num_numbers for pose in places):
        expected = f"a pose of {num_numbers} numbers in each line of the poses"
        raise InputError(f"{path}: expected {expected}, got {len(places[0].split())}; TUM's have a time, KITTI's none")
    if stamps is not None and len({*stamps}) < len(stamps):
        raise InputError(f"{path}: expected different times, got one twice; drop either image")
    if stamps is None:
        lines = places
    else:
        timed = sorted(zip(stamps, poses, strict=True), key=lambda pair: pair[0])
        lines = [f"{_seconds(stamp)} {pose}" for stamp, pose in timed if pose is not None]
    require_replaceable(path)
    write_text(path, "".join(f"{line}\n" for line in lines))


def _lines(path: Path, kind: str) -> list[tuple[str, str]]:
    """Lines without spaces around them, each with its place for messages; no empty lines, no comments after #."""
    with reading(path, mend=f"expected {kind}"):
        text = path.read_text(encoding="utf-8-sig")
    lines = ((f"{path}: line {number}", line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [(where, line) for where, line in lines if line and not line.startswith("#")]


def _seconds(stamp: int) -> str:
    return f"{stamp // SECOND}.{stamp % SECOND:09d}"
