"""Poses and trajectories of TUM and KITTI, and times of images."""

import numpy as np
import pytest

from mfvpr.io import read_poses, read_stamps, stamps_in_names, write_trajectory
from mfvpr.io.trajectories import parse_stamp
from tests.io.checks import one_line_error

NAMES = ["0.png", "1.png", "2.png"]
TUM = [
    "12.5 1 -2.50 3e-3 0 0 0 1",
    "12.75 +1.0 2 3 0.0 0 0.70710678118654757 0.70710678118654757",
    "13 0.1000000000000000055 -0 3 0 0 0 -1",
]
KITTI = ["1 0 0 1.50 0 1 0 -2e-3 0 0 1 3", "1.0 0 0 4 0 1 0 5 0 0 1 6", "1 0 0 7 0 1 0 8 0 0 1 9"]
MARKED = ["\ufeff# timestamp tx ty tz qx qy qz qw", ""]


@pytest.fixture
def write(tmp_path):
    """Writes a file of these lines."""

    def call(lines, newline="\n"):
        (tmp_path / "poses.txt").write_bytes(newline.join(lines).encode())
        return tmp_path / "poses.txt"

    return call


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_numbers_stay_digit_for_digit(write, tmp_path, newline):
    poses = read_poses(write([*MARKED, *TUM], newline), NAMES)
    assert poses == [line.partition(" ")[2] for line in TUM]
    stamps = [1403636579763555584, 1403636579813555456, 1403636580000000001]
    write_trajectory(tmp_path / "tum.txt", [poses[2], None, poses[0]], stamps)
    expected = f"1403636579.763555584 {poses[2]}\n1403636580.000000001 {poses[0]}\n"
    assert (tmp_path / "tum.txt").read_bytes() == expected.encode()
    poses = read_poses(write([MARKED[1], *KITTI], newline), NAMES)
    assert poses == KITTI
    write_trajectory(tmp_path / "kitti.txt", poses[::-1])
    assert (tmp_path / "kitti.txt").read_text().splitlines() == KITTI[::-1]


def test_what_is_written_is_read(tmp_path):
    rows = [" ".join(map(repr, row)) for row in np.random.default_rng(0).normal(size=(5, 7)).tolist()]
    stamps = [10**18 + 12345678901 * row for row in (3, 0, 4, 1, 2)]  # written in the order of time
    write_trajectory(tmp_path / "tum.txt", rows, stamps)
    names = [f"cam0/{stamp}.png" for stamp in sorted(stamps)]
    assert read_poses(tmp_path / "tum.txt", names) == [rows[row] for row in np.argsort(stamps)]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (TUM[:2], "expected a pose of each of the 3 images, got 2"),
        ([*TUM[:2], "13 1 2 3 0 0 0"], "line 3: expected 8 .* got '13 1 2 3 0 0 0'"),
        ([*TUM[:2], "13 nan 2 3 0 0 0 1"], "line 3: expected .* finite numbers .*got '13 nan"),
        ([*TUM[:2], "13 1_0 2 3 0 0 0 1"], "line 3: expected .* finite numbers .*got '13 1_0"),
        ([*KITTI[:2], KITTI[2].replace("9", "1e999")], "line 3: expected .* finite numbers .*1e999"),
        ([TUM[0], TUM[2], TUM[1]], "line 3: expected ascending timestamps, got 12.750000000 after 13.000000000"),
        ([*TUM[:2], "-1 1 2 3 0 0 0 1"], "line 3: expected a time in s, .* got '-1'"),
    ],
)
def test_other_files_are_one_line(write, lines, message):
    with one_line_error(message, "poses.txt"):
        read_poses(write(lines), NAMES)


def test_poses_belong_to_the_times_of_the_images(write):
    names = ["rgb/12.504.png", "rgb/12.745.png", "rgb/13.009.png"]
    assert len(read_poses(write(TUM), names)) == 3
    with one_line_error(r"line 3: expected the time of rgb/13\.011\.png within 10 ms, got 13\.000000000"):
        read_poses(write(TUM), [*names[:2], "rgb/13.011.png"])
    assert len(read_poses(write(KITTI), names)) == 3


@pytest.mark.parametrize(
    ("poses", "stamps", "message"),
    [
        ([KITTI[0], None], None, "a place of all images, .* got 1 places of 2 images"),
        ([None, None], [1, 2], "for TUM of at least one, got 0 places of 2 images"),
        (["1 2 3 0 0 0 1"] * 2, [5, 5], "expected different times"),
        (["1 2 3 0 0 0 1"] * 2, None, "expected a pose of 12 numbers"),
        (KITTI[:2], [1, 2], "expected a pose of 7 numbers"),
    ],
)
def test_trajectories_that_cannot_be_written(tmp_path, poses, stamps, message):
    with one_line_error(message, "tum.txt"):
        write_trajectory(tmp_path / "tum.txt", poses, stamps)
    assert not list(tmp_path.iterdir())


def test_times_are_exact():
    for text, stamp in {
        "1403636579763555584": 1403636579763555584,  # float64 would give ...555600
        "1403636579.763555584": 1403636579763555584,
        "1.403636579763555527e+09": 1403636579763555527,
        "1418132433446018": 1418132433446018000,
        "1418132433446": 1418132433446000000,
        "1418132433": 1418132433000000000,
        "0": 0,
        "7.": 7000000000,
        "0.0000000016": 2,
    }.items():
        assert parse_stamp(text) == stamp
    for text in ("", "nan", "-1", "1_0", "1e10", "2147483648", "14036365797635", "9" * 19, "1e-9999", "1,5"):
        with one_line_error("expected a time"):
            parse_stamp(text)


def test_names_that_are_times():
    names = ["cam0/1403636579763555584.png", "12.345.png", "1418132433.jpg"]
    assert stamps_in_names(names) == [1403636579763555584, 12345000000, 1418132433000000000]
    for name in ("0001.png", "0000000005.png", "12.png", "frame_12.5.png", "12345678901.png", "film.mp4:12", "9" * 19):
        with one_line_error(None, name[-12:]):
            stamps_in_names([*names, name])


def test_files_of_times(write):
    assert read_stamps(write(["# s", "0.000000e+00", "", "1.036224e-01\r"]), 2) == [0, 103622400]
    with one_line_error("poses.txt: expected times of 3 images, a line for each, got 2"):
        read_stamps(write(["1", "2"]), 3)
    with one_line_error("line 2: expected a time in s, .* got '2 3'"):
        read_stamps(write(["1", "2 3"]), 2)
