"""Makes matches.npz: files of matches by hloc, kapture, COLMAP and vismatch, and the matches that their readers give.

`python -m tests.golden matches HLOC street`, beside the images of `draw_streets("street", seed=3, num_frames=2)`.
"""

import os
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

QUERIES = ("queries/0000.png", "queries/0001.png")
DATABASE = ("database/0000.png", "database/0001.png")
PAIRS = [(query, database) for query in QUERIES for database in DATABASE][:3]  # the last pair is not matched
KEYPOINTS = 48


def main(hloc: str, images: str) -> dict[str, np.ndarray]:
    sys.path.insert(0, hloc)
    work = Path(tempfile.mkdtemp())
    expected: dict[str, np.ndarray] = {}
    write_hloc(work, images, expected)
    write_kapture(work, expected)
    write_colmap(work, images, expected)
    write_vismatch(work, images, expected)
    files = [path for path in sorted(work.rglob("*")) if path.is_file()]
    contents = {f"files/{path.relative_to(work)}": np.frombuffer(path.read_bytes(), np.uint8) for path in files}
    return contents | {f"expected/{name}": values for name, values in expected.items()}


def add(expected: dict, tool: str, pair: tuple[str, str], points0, points1, confidence=None) -> None:
    for name, values in (("points0", points0), ("points1", points1), ("confidence", confidence)):
        if values is not None:
            expected[f"{tool}/{pair[0]}:{pair[1]}:{name}"] = np.asarray(values, np.float32)


def write_hloc(work: Path, images: str, expected: dict) -> None:
    from hloc import extract_features, match_features
    from hloc.utils.io import get_keypoints, get_matches

    folder = work / "hloc"
    folder.mkdir()
    conf = {**extract_features.confs["sift"]}
    conf["model"] = {**conf["model"], "options": {"max_num_features": KEYPOINTS, "first_octave": 0}}
    names = [*QUERIES, *DATABASE]
    features = extract_features.main(conf, Path(images), image_list=names, feature_path=folder / "feats.h5")
    pairs = work / "pairs.txt"
    pairs.write_text("\n".join(" ".join(pair) for pair in PAIRS) + "\n")
    matches = folder / "matches.h5"
    match_features.main(match_features.confs["NN-mutual"], pairs, features=features, matches=matches)
    pairs.unlink()
    for pair in PAIRS:
        numbers, scores = get_matches(matches, *pair)
        points = [get_keypoints(features, name)[of_image] for name, of_image in zip(pair, numbers.T, strict=True)]
        add(expected, "hloc", pair, *points, scores)


def write_kapture(work: Path, expected: dict) -> None:
    """hloc's features and matches, by kapture's library: the first name of a pair is the smaller."""
    import kapture
    import kapture.io.csv
    from hloc.utils.io import get_keypoints, get_matches
    from kapture.io import features as files

    root = str(work / "kapture")
    for name in (*QUERIES, *DATABASE):
        path = files.get_keypoints_fullpath("sift", root, name)
        os.makedirs(os.path.dirname(path), exist_ok=True)
        files.image_keypoints_to_file(path, get_keypoints(work / "hloc/feats.h5", name).astype(np.float32))
    layout = os.path.join(root, "reconstruction/keypoints/sift/keypoints.txt")
    kapture.io.csv.keypoints_to_file(layout, kapture.Keypoints("sift", np.float32, 2))
    for pair in PAIRS:
        numbers, scores = get_matches(work / "hloc/matches.h5", *pair)
        rows = np.column_stack([numbers[:, ::-1] if pair[0] > pair[1] else numbers, scores]).astype(np.float64)
        path = files.get_matches_fullpath(tuple(sorted(pair)), "sift", root)
        os.makedirs(os.path.dirname(path), exist_ok=True)
        files.image_matches_to_file(path, rows)
        rows = files.image_matches_from_file(path)
        points = {}
        for name, of_image in zip(sorted(pair), rows.T[:2].astype(int), strict=True):
            path = files.get_keypoints_fullpath("sift", root, name)
            points[name] = files.image_keypoints_from_file(path, np.float32, 2)[of_image]
        add(expected, "kapture", pair, points[pair[0]], points[pair[1]], rows[:, 2])


def write_colmap(work: Path, images: str, expected: dict) -> None:
    """hloc's features and matches, by COLMAP's library; the first half of the matches are inliers."""
    import pycolmap
    from hloc.utils.io import get_keypoints, get_matches

    path = work / "colmap.db"
    with pycolmap.Database.open(path):
        pass
    pycolmap.import_images(path, images, pycolmap.CameraMode.SINGLE)
    with pycolmap.Database.open(path) as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        for name in (*QUERIES, *DATABASE):  # COLMAP's first pixel has its center at 0.5
            keypoints = get_keypoints(work / "hloc/feats.h5", name).astype(np.float32) + np.float32(0.5)
            database.write_keypoints(numbers[name], keypoints)
        for pair in PAIRS:
            first, second = (numbers[name] for name in pair)
            matches = get_matches(work / "hloc/matches.h5", *pair)[0].astype(np.uint32)
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = matches[: len(matches) // 2]
            database.write_matches(first, second, matches)
            database.write_two_view_geometry(first, second, geometry)
        readers = {"colmap": database.read_matches, "verified": read_inliers(database)}
        for tool, read in readers.items():
            for pair in PAIRS:
                first, second = (numbers[name] for name in pair)
                points0, points1 = (database.read_keypoints(number)[:, :2] - 0.5 for number in (first, second))
                matches = np.asarray(read(first, second), int).reshape(-1, 2)
                add(expected, tool, pair, points0[matches[:, 0]], points1[matches[:, 1]])


def read_inliers(database):
    return lambda first, second: database.read_two_view_geometry(first, second).inlier_matches


def write_vismatch(work: Path, images: str, expected: dict) -> None:
    import torch
    import vismatch_match

    pairs, folder = work / "pairs.txt", work / "vismatch"
    pairs.write_text("\n".join(" ".join(f"{images}/{name}" for name in pair) for pair in PAIRS) + "\n")
    options = f"--matcher sift-nn --device cpu --no-viz --n-kpts {KEYPOINTS} --input {pairs} --out-dir {folder}"
    sys.argv = ["vismatch-match", *options.split()]
    vismatch_match.main()
    pairs.unlink()
    for number, pair in enumerate(PAIRS):
        result = SimpleNamespace(**torch.load(folder / f"output_{number}_result.torch", weights_only=False))
        add(expected, "vismatch", pair, result.matched_kpts0, result.matched_kpts1, result.matched_confidences)
        add(expected, "inliers", pair, result.inlier_kpts0, result.inlier_kpts1)
