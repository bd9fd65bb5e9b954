"""Files of matches as other programs write them."""

from pathlib import Path

import h5py
import numpy as np

from mfvpr.io import Images, open_matches

GOLDEN = np.load(Path(__file__).parents[1] / "golden/matches.npz")
QUERIES, DATABASE = ["0000.png", "0001.png"], ["0000.png", "0001.png"]
SIZE = (448, 336)
POINTS = np.float32([[10, 20], [30, 40], [50, 60]])


def write_tool_files(root):
    """The files that hloc, kapture, COLMAP and vismatch wrote."""
    for name in GOLDEN:
        if name.startswith("files/"):
            path = root / name.removeprefix("files/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(GOLDEN[name].tobytes())
    return root


def side(prefix, names, features=None):
    """Images with the names that the tools know."""
    return Images([prefix + name for name in names], size=lambda row: SIZE, features=features)


def write_hloc(path, pairs, **arrays):
    """hloc's file of matches, with the same arrays for each pair."""
    with h5py.File(path, "w", libver="latest") as file:
        for pair in pairs:
            for name, values in arrays.items():
                file[f"{pair}/{name}"] = values
    return path


def npz_folder(tmp_path, name="q1_d1_matches.npz", **arrays):
    folder = tmp_path / "pairs"
    folder.mkdir(exist_ok=True)
    np.savez(folder / name, **arrays)
    return folder


def pair_of(folder, **options):
    [matches] = open_matches(folder, Images(["q1.jpg"]), Images(["d1.jpg"]), **options).read(0, [0])
    return matches
