"""Read poses of images, and write the trajectory of localized images: TUM's and KITTI's text files."""

import math
from collections.abc import Sequence
from pathlib import Path

from mfvpr.io.checks import parse_number
from mfvpr.io.containers import shorten
from mfvpr.io.stamps import SECOND, parse_line_stamp, read_content_lines, stamps_in_names
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable, write_text

_TUM, _KITTI = 7, 12  # numbers of a pose
_WORDS = (_TUM + 1, _KITTI)  # of a line
_LARGEST_GAP = SECOND // 100  # between an image and its pose, as evo allows


def read_poses(path: Path | str, names: Sequence[str]) -> list[str]:
    """Poses of the images `names`, each as the text of its numbers with a space between them.

    Args:
        path: TUM, lines `timestamp tx ty tz qx qy qz qw`, or KITTI, lines of 12 numbers: the first three rows of the
            pose's matrix. # begins a comment. A line for each image, in the order of `names`.
        names: `[M]` relative POSIX paths in natural order. If they are times, as `stamps_in_names` reads them, TUM's
            timestamps must be the same within 10 ms.

    Returns:
        `[M]` texts of 7 or 12 numbers, digit for digit as in the file.

    Raises:
        InputError: the file is missing or damaged; a line has other numbers; timestamps do not ascend, or differ from
            the images'; or the number of poses is not M.
    """
    path = Path(path)
    lines = [(where, line.split()) for where, line in read_content_lines(path, "a text file of poses")]
    num_words = len(lines[0][1]) if lines else 0
    for where, words in lines:
        if len(words) != num_words or num_words not in _WORDS:
            raise InputError(f"{where}: expected 8 numbers (TUM) or 12 (KITTI) in all lines, got {len(words)}")
    if len(lines) != len(names):
        raise InputError(f"{path}: expected a pose of each of the {len(names)} images, got {len(lines)}")
    if num_words == _KITTI:
        return [_pose(where, words) for where, words in lines]
    _check_stamps(path, lines, names)
    return [_pose(where, words[1:]) for where, words in lines]


def write_trajectory(path: Path | str, poses: Sequence[str | None], stamps: Sequence[int] | None = None) -> None:
    """Write the poses of localized images, atomically, digit for digit.

        poses = mfvpr.io.read_poses("database.tum", data.database.names)
        stamps = mfvpr.io.stamps_in_names(data.queries.names)
        write_trajectory("queries.tum", [poses[row] for row in rows], stamps)  # database rows of the predictions

    Args:
        path: new text file.
        poses: `[Q]` texts of 7 numbers (TUM) or 12 numbers (KITTI), as `read_poses` returns them; None = no place.
        stamps: `[Q]` times in ns, for TUM; None for KITTI.

    TUM: lines are in the order of time, and an image without a place has none. KITTI: a line is a frame, so all images
    need a place.

    Raises:
        InputError: the file exists; there is no pose at all, or none of a KITTI frame; a pose has other numbers; or
            two images have the same time.
    """
    path = Path(path)
    if len({*(stamps or ())}) < len(stamps or ()):
        raise InputError(f"{path}: expected different times, got one twice")
    places = [pose for pose in poses if pose is not None]
    if not places or (stamps is None and len(places) < len(poses)):
        expected = "all images, since a line of KITTI is a frame; write TUM" if stamps is None else "at least one image"
        raise InputError(f"{path}: expected a place of {expected}, got {len(places)} places of {len(poses)} images")
    num_numbers = _KITTI if stamps is None else _TUM
    if any(len(pose.split()) != num_numbers for pose in places):
        raise InputError(f"{path}: expected poses of {num_numbers} numbers; TUM needs times, KITTI has none")
    if stamps is None:
        lines = places
    else:
        timed = sorted(zip(stamps, poses, strict=True), key=lambda pair: pair[0])
        lines = [f"{_seconds(stamp)} {pose}" for stamp, pose in timed if pose is not None]
    require_replaceable(path)
    write_text(path, "".join(f"{line}\n" for line in lines))


def _pose(where: str, words: Sequence[str]) -> str:
    """Text of a pose, if all its words are finite numbers."""
    try:
        is_finite = all(math.isfinite(parse_number(word)) for word in words)
    except ValueError:
        is_finite = False
    if not is_finite:
        raise InputError(f"{where}: expected finite numbers, got {shorten(' '.join(words))!r}")
    return " ".join(words)


def _check_stamps(path: Path, lines: Sequence[tuple[str, Sequence[str]]], names: Sequence[str]) -> None:
    """Raise an InputError unless the timestamps ascend, and are those of the images if their names are times."""
    stamps = [parse_line_stamp(where, words[0]) for where, words in lines]
    for (where, _), before, stamp in zip(lines[1:], stamps, stamps[1:], strict=False):
        if stamp <= before:
            raise InputError(
                f"{where}: expected ascending timestamps, got {_seconds(stamp)} after {_seconds(before)}; sort the "
                "lines by time"
            )
    try:
        image_stamps = stamps_in_names(names)
    except InputError:
        return
    for (where, _), stamp, image_stamp, name in zip(lines, stamps, image_stamps, names, strict=True):
        if abs(stamp - image_stamp) > _LARGEST_GAP:
            raise InputError(
                f"{where}: expected the pose of {shorten(name)}, within 10 ms, got one at {_seconds(stamp)}; take the "
                "pose at the time of each image"
            )


def _seconds(stamp: int) -> str:
    return f"{stamp // SECOND}.{stamp % SECOND:09d}"
