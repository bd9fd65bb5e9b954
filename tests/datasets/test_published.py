"""Published data sets from miniature trees in their exact layouts."""

import csv
import itertools

import numpy as np
import pytest

from mfvpr.datasets.published import CONDITIONS, REFERENCE, published_dataset, published_differences
from tests.builders import fill
from tests.io.checks import one_line_error
from tests.random_checkpoints import write_matlab


def put(root, *names):
    fill(root, names)


def rows(dataset, threshold, sequence=0):
    positives = dataset.sequences[sequence].truth.positives(threshold)
    return [positives.of(query).tolist() for query in range(len(positives))]


def check_error(name, root, words, **options):
    with one_line_error(None, words):
        published_dataset(name, root, **options)


def test_an_unknown_name_lists_the_known_ones(tmp_path):
    check_error("gardens_pont", tmp_path, "gardens_pont: expected a published data set, of ")


# SSM-VPR


@pytest.fixture
def ssm(tmp_path):
    put(tmp_path, *(f"Reference/image{i:04d}.png" for i in range(12)), *(f"Live/image{i:05d}.jpg" for i in range(3)))
    (tmp_path / "GroundTruth.csv").write_text("Reference,Live\n0,0\n10,1\n4,2\n")
    return tmp_path


@pytest.mark.parametrize(
    "name", ["berlin_a100", "berlin_halenseestrasse", "berlin_kudamm", "gardens_point", "nordland_1415"]
)
def test_ssm_vprs_are_right_around_the_named_image(ssm, name):
    dataset = published_dataset(name, ssm)
    assert dataset.name == dataset.only.name == name
    assert (len(dataset.database), len(dataset.queries)) == (12, 3)
    assert rows(dataset, 1) == [[0, 1], [9, 10, 11], [3, 4, 5]]
    assert dataset.truth.thresholds(tolerances=[1, 2, 5], radius=25) == [1, 2, 5]


@pytest.mark.parametrize(("side", "number"), [("Reference", 5), ("Live", 0)])
def test_a_gap_is_an_error_because_the_table_counts_numbers(ssm, side, number):
    next((ssm / side).glob(f"*{number:04d}.*")).unlink()
    check_error("gardens_point", ssm, f"{ssm / side}: expected images numbered from 0 without gaps")


# RobotCar


def write_poses(root, centers, suffix=".jpg"):
    """Write a camera-to-world matrix per image, each turned by another angle, and the images."""
    lines = []
    for number, (name, (x, y, z)) in enumerate(centers.items()):
        cosine, sine = np.cos(number), np.sin(number)
        matrix = [cosine, -sine, 0, x, sine, cosine, 0, y, 0, 0, 1, z, 0, 0, 0, 1]
        lines.append(f"{name}{suffix} {' '.join(f'{value:.9f}' for value in matrix)}\n")
    (root / "robotcar_v2_train.txt").write_text("".join(lines))
    put(root, *(f"images/{name}.jpg" for name in centers))


def place(condition, timestamp):
    return f"{condition}/rear/{timestamp}"


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_robotcar_takes_the_nearest_reference_within_five_meters(tmp_path, suffix):
    centers = {place(REFERENCE, 30): (0, 0, 0), place(REFERENCE, 10): (20, 0, 0), place(REFERENCE, 20): (10, 0, 0)}
    for number, condition in enumerate(CONDITIONS):
        centers |= {
            place(condition, 200): (14.9, 0, 0),
            place(condition, 100): (3, 0, 4.1 if number == 2 else 4),
            place(condition, 300): (0, 900, 0),
        }
    centers |= {place("sun", 1): (0, 0, 0), "dawn/left/7": (0, 0, 0), place(CONDITIONS[1], 400): (5, 0, 0)}
    write_poses(tmp_path, centers, suffix)
    dataset = published_dataset("robotcar_seasons", tmp_path)
    assert dataset.database.names == tuple(f"{REFERENCE}/rear/{time}.jpg" for time in (10, 20, 30))
    assert [sequence.name for sequence in dataset.sequences] == list(CONDITIONS)
    assert dataset.sequences[0].images.names == ("dawn/rear/100.jpg", "dawn/rear/200.jpg")
    assert rows(dataset, 0) == [[2], [1]]  # 5 m is near enough; of the order of timestamps
    assert rows(dataset, 1) == [[1, 2], [0, 1, 2]]
    assert rows(dataset, 0, 1) == [[2], [1], [1]]  # of two that are equally near the first
    assert dataset.sequences[2].images.names == ("night/rear/200.jpg",)  # 5.08 m is not
    assert all(path.is_file() for sequence in dataset.sequences for path in sequence.images.paths)


def test_faults_of_robotcar(tmp_path):
    check_error("robotcar_seasons", tmp_path, "robotcar_v2_train.txt: expected a list, got nothing")
    centers = {place(condition, 1): (0, 0, 0) for condition in (REFERENCE, *CONDITIONS)}
    write_poses(tmp_path, centers)
    (tmp_path / "images/snow/rear/1.jpg").unlink()
    check_error(
        "robotcar_seasons", tmp_path, "expected 1 images of robotcar_v2_train.txt, got all but 1, the first of which"
    )
    write_poses(tmp_path, {name: center for name, center in centers.items() if "rain" not in name})
    check_error("robotcar_seasons", tmp_path, "expected poses of night-rain/rear, got none")
    for numbers in ("1 2 3", "nan " * 16, "1 0 0 0 0 1 0 0 0 0 1 0 7 7 7 1"):  # the last is transposed
        (tmp_path / "robotcar_v2_train.txt").write_text(f"\ndawn/rear/1.jpg {numbers}\n")
        check_error("robotcar_seasons", tmp_path, "the 16 numbers of a pose by rows, the last 0 0 0 1")


# Nordland


def test_nordland_pairs_frames_of_one_number(tmp_path):
    put(tmp_path, *(f"{season}/images-{i:05d}.png" for season in ("summer", "winter", "fall") for i in (7, 8, 12)))
    dataset = published_dataset("nordland_27592", tmp_path)
    assert (dataset.database.root.name, dataset.queries.root.name) == ("summer", "winter")
    assert rows(dataset, 0) == [[0], [1], [2]]
    assert rows(dataset, 1) == [[0, 1], [0, 1, 2], [1, 2]]
    turned = published_dataset("nordland_27592", tmp_path, seasons=("winter", "fall"))
    assert (turned.database.root.name, turned.queries.root.name) == ("winter", "fall")
    check_error("nordland_27592", tmp_path, "expected two of fall, spring", seasons=("may", "fall"))
    (tmp_path / "winter/images-00008.png").rename(tmp_path / "winter/images-00009.png")
    check_error("nordland_27592", tmp_path, "first that differ are images-00008 and images-00009")
    (tmp_path / "winter/images-00009.png").unlink()
    check_error("nordland_27592", tmp_path, "got 2 and 3 frames")
    for name in ("images-00008.png", "images-00008.jpg"):
        (tmp_path / "winter" / name).write_bytes(b"")
    check_error("nordland_27592", tmp_path, "got 4 and 3 frames")


def test_nordland_takes_the_frames_of_patch_netvlads_lists(tmp_path):
    put(tmp_path, *(f"{season}/images-{i:05d}.png" for season in ("summer", "winter") for i in range(9)))
    for side, season in (("index", "summer"), ("query", "winter")):
        lines = "".join(f"./nordland/{season}/images-{i:05d}.png\n" for i in (2, 3, 6))
        (tmp_path / f"nordland_imageNames_{side}.txt").write_text(lines)
    dataset = published_dataset("nordland_27592", tmp_path)
    assert dataset.database.names == dataset.queries.names == tuple(f"images-{i:05d}.png" for i in (2, 3, 6))
    (tmp_path / "winter/images-00003.png").unlink()
    check_error("nordland_27592", tmp_path, "expected 3 images of nordland_imageNames_query.txt, got all but 1")


def test_nordlands_test_part_is_two_sections(tmp_path):
    names = [
        f"{season}_images_test/section{part}/{i}.png"
        for season in ("summer", "winter")
        for part in (1, 2)
        for i in (9, 10)
    ]
    put(tmp_path, *names)
    dataset = published_dataset("nordland_3450", tmp_path)
    assert dataset.database.names == ("section1/9.png", "section1/10.png", "section2/9.png", "section2/10.png")
    assert rows(dataset, 0) == [[0], [1], [2], [3]]
    assert rows(dataset, 2) == [[0, 1], [0, 1], [2, 3], [2, 3]]  # a frame of section 2 is none of section 1
    assert dataset.truth.distance(1).tolist() == [1, 0, np.inf, np.inf]


def test_vpr_bench_asks_every_tenth_frame(tmp_path):
    put(tmp_path, *(f"ref/{i:07d}.jpg" for i in range(30)), *(f"query/{i:07d}.jpg" for i in range(3)))
    assert rows(published_dataset("nordland_vprbench", tmp_path), 1) == [[0, 1], [9, 10, 11], [19, 20, 21]]
    put(tmp_path, "query/0000003.jpg")
    check_error("nordland_vprbench", tmp_path, "got 30 for 4")


# Pittsburgh

DATABASE = [f"00{i}/00{i}829_pitch1_yaw{i + 1}.jpg" for i in range(3)]
QUERIES = [f"00{i}/00{i}546_pitch1_yaw1.jpg" for i in range(2)]
PLACES = np.array([[584000.0, 4476000], [584025.0, 4476000], [584060.0, 4476000]])
QUERY_PLACES = np.array([[584025.0, 4476025], [584010.0, 4476000]])


@pytest.fixture
def pittsburgh(tmp_path):
    put(tmp_path, *DATABASE, *(f"queries_real/{name}" for name in QUERIES))
    return tmp_path


def objects(*parts):
    content = np.empty(len(parts), object)
    content[:] = parts
    return content


def cells(names):
    return objects(*names)[:, None]


def write_structure(path, places=PLACES, **changes):
    path.parent.mkdir(exist_ok=True)
    content = {
        "whichSet": "val",
        "dbImageFns": cells(DATABASE),
        "utmDb": places.T,
        "qImageFns": cells(QUERIES),
        "utmQ": QUERY_PLACES.T,
        "numImages": 3,
        "numQueries": 2,
        "posDistThr": 25,
        "posDistSqThr": 625,
        "nonTrivPosDistSqThr": 100,
    }
    write_matlab(path, {"dbStruct": content | changes})


@pytest.mark.parametrize("folder", ["datasets/", ""])
def test_pittsburgh_is_correct_within_25_m(pittsburgh, folder):
    write_structure(pittsburgh / f"{folder}pitts30k_val.mat")
    dataset = published_dataset("pitts30k_val", pittsburgh)
    assert dataset.database.names == tuple(DATABASE)
    assert dataset.queries.names == tuple(f"queries_real/{name}" for name in QUERIES)
    assert rows(dataset, 25) == [[1], [0, 1]]
    check_error("pitts30k_test", pittsburgh, "pitts30k_test.mat: expected the lists of the data set, got nothing")


# MSLS


def write_table(path, header, lines):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([["", *header], *([number, *line] for number, line in enumerate(lines))])


@pytest.fixture
def msls(tmp_path):
    """Per city three database images, 100 m apart, one of them a panorama, and four query images, one of them used."""
    for city, first in (("cph", 0), ("sf", 1e6)):
        for side, images in (
            ("database", [("d0", 0, False, True), ("d1", 100, True, True), ("d2", 200, False, True)]),
            (
                "query",
                [("q0", 24, False, True), ("q1", 101, False, True), ("q2", 1, True, True), ("q3", 2, False, False)],
            ),
        ):
            folder = tmp_path / "train_val" / city / side
            put(folder, *(f"images/{key}.jpg" for key, *_ in images))
            for table, header, lines in (
                ("raw", ["key", "lon", "pano"], [(key, 0, is_pano) for key, _, is_pano, _ in images[::-1]]),
                ("postprocessed", ["key", "easting", "northing"], [(key, first + x, 5e6) for key, x, _, _ in images]),
                ("subtask_index", ["key", "all", "s2w"], [(key, is_task, False) for key, _, _, is_task in images]),
            ):
                write_table(folder / f"{table}.csv", header, lines)
    return tmp_path


def test_msls_of_tables(msls):
    dataset = published_dataset("msls_val", msls)
    assert dataset.database.names == tuple(
        f"train_val/{city}/database/images/{key}.jpg" for city, key in itertools.product(("cph", "sf"), ("d0", "d2"))
    )
    assert dataset.queries.names == tuple(f"train_val/{city}/query/images/q0.jpg" for city in ("cph", "sf"))
    assert rows(dataset, 25) == [[0], [2]]


def test_faults_of_msls(msls):
    check_error("msls_val", msls / "train_val", "postprocessed.csv: expected a table")
    for table, before, after, words in (
        ("subtask_index", "q3", "q4", "expected equal keys"),
        ("postprocessed", "q3", "q2", "expected equal keys"),
        ("postprocessed", "easting", "east", "expected pano and all (True"),
        ("postprocessed", "5000000.0", "nan", "expected positions"),
    ):
        path = msls / f"train_val/sf/query/{table}.csv"
        text = path.read_text()
        path.write_text(text.replace(before, after))
        check_error("msls_val", msls, words)
        path.write_text(text)


# All


def test_numbers_of_images_are_compared_with_the_published(ssm):
    assert list(published_differences(published_dataset("berlin_a100", ssm))) == [
        "12 database images where 85 are published",
        "3 queries in berlin_a100 where 81 are published",
    ]
    put(ssm, *(f"Reference/image{i:04d}.png" for i in range(85)), *(f"Live/image{i:05d}.jpg" for i in range(81)))
    (ssm / "GroundTruth.csv").write_text("Reference,Live\n" + "".join(f"0,{i}\n" for i in range(81)))
    assert list(published_differences(published_dataset("berlin_a100", ssm))) == []
