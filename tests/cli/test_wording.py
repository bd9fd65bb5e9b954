"""Errors of the library, in words of the settings."""

import numpy as np
import pytest
from PIL import Image

from mfvpr.io import write_features, write_global_descriptors
from tests.builders import make_features, unit
from tests.needs import skip_without

SIZE = 64


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Three images on either side and their features, of another program: called by other paths, of other lengths."""
    skip_without("h5py")
    root, rng = tmp_path_factory.mktemp("wording"), np.random.default_rng(0)
    names, features = [], []
    for side in ("database", "queries", "broken"):
        (root / side).mkdir()
        for row in range(3):
            picture = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
            Image.fromarray(picture).save(root / side / f"{row}.png")
            names.append(f"{side}/{row}.png")
            features.append(make_features(rng, 5, size=SIZE))
    content = (root / "broken" / "1.png").read_bytes()
    (root / "broken" / "1.png").write_bytes(content[: len(content) // 2])
    write_features(root / "both.h5", names, enumerate(features))
    vectors = unit(rng.normal(size=(len(names), 4)))
    write_global_descriptors(root / "both_vectors.h5", names, vectors)
    plain = [f"{row}.png" for row in range(3)]
    write_features(root / "some.npz", plain[:2], enumerate(features[:2]))
    write_global_descriptors(root / "long.npz", plain, 2 * vectors[:3])
    parts = {part: np.asarray(getattr(features[0], part)) for part in ("keypoints", "descriptors", "scores")}
    np.savez(root / "sizeless.npz", **{f"{name}/{part}": array for name in plain for part, array in parts.items()})
    np.savez(root / "long_features.npz", **{
        f"{name}/{part}": array * (2 if part == "descriptors" else 1)
        for name in plain for part, array in (parts | {"image_size": np.array([SIZE, SIZE])}).items()
    })  # fmt: skip
    return root


def files(group, file):
    return [f"{group}=import", *(f"{group}.{side}=ROOT/{file}" for side in ("database", "queries"))]


ORDER = "dataset.ground_truth=order"


@pytest.mark.parametrize(("arguments", "words"), [
    (["dataset.ground_truth=index"], "dataset.index_file=FILE"),
    (["dataset.ground_truth=label"], "dataset.database_labels=FILE"),
    ([ORDER, "dataset.index_file=a.csv"], "dataset.index_file, but dataset.ground_truth=order"),
    ([ORDER, "dataset.exclude_neighbors=1"], "error: dataset.exclude_neighbors=1: expected"),
    ([ORDER, "retrieval.num_words=99"], "or lower retrieval.num_words"),
    ([ORDER, "dataset.queries=ROOT/broken"], "or set on_bad_image=skip"),
    ([ORDER, "dataset=sequences", "dataset.queries=[ROOT/queries,ROOT/mean]"], "error: dataset.queries: expected"),
    ([ORDER, *files("features", "both.h5")], "features.database_prefix=... and features.query_prefix=..."),
    ([ORDER, *files("retrieval", "both_vectors.h5")], "retrieval.database_prefix=... and retrieval.qu"),
    ([ORDER, *files("features", "some.npz")], "features.database_prefix and features.query_prefix"),
    ([ORDER, *files("features", "sizeless.npz")], "features.image_size=[W,H]"),
    ([ORDER, *files("features", "long_features.npz")], "features.lengths=normalize"),
    ([ORDER, *files("retrieval", "long.npz")], "retrieval.lengths=normalize"),
])  # fmt: skip
def test_what_is_refused_says_which_setting_mends_it(images, tmp_path, monkeypatch, refuse, arguments, words):
    monkeypatch.chdir(tmp_path)
    sides = [f"dataset.{side}={images}/{side}" for side in ("database", "queries")]
    defaults = ("dataset=folder", *sides, "cache=null", "candidates=2", "scorer=count")
    typed_here = [argument.replace("ROOT", str(images)) for argument in arguments]
    names = {argument.partition("=")[0] for argument in typed_here}
    settings = [default for default in defaults if default.partition("=")[0] not in names]
    settings += [] if "features=import" in typed_here else ["features.image_size=[64,64]"]
    settings += [] if {"retrieval=import", "retrieval.num_words=99"} & {*typed_here} else ["retrieval.num_words=2"]
    assert words in refuse("evaluate", *settings, *typed_here)


def test_a_sweep_says_how_one_sequence_is_chosen(images, tmp_path, monkeypatch, refuse):
    monkeypatch.chdir(tmp_path)
    several = ("dataset=sequences", f"dataset.database={images}/database", ORDER,
               f"dataset.queries=[{images}/queries,{images}/database]", "scorer=sum", "grid.clamp=[true]")  # fmt: skip
    assert "got 2; give one folder as dataset.queries=[DIR]" in refuse("sweep", *several, "cache=null")
