"""Names of images in files: the path, the end of it, or the same without suffix; never a guess."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import InputError, Shortlist
from mfvpr.io import write_features, write_global_descriptors, write_shortlist
from mfvpr.io.containers import match_names
from tests.io.checks import one_line_error
from tests.io.other_programs import feature

FILE = Path("feats.h5")


@pytest.mark.parametrize(
    "names, foreign, expected",
    [
        (["a/1.jpg", "b/1.jpg"], ["b/1.jpg", "a/1.jpg"], ["a/1.jpg", "b/1.jpg"]),
        (["1.jpg", "2.jpg"], ["db/2.jpg", "db/1.jpg"], ["db/1.jpg", "db/2.jpg"]),
        (["a/1.jpg", "a/2.jpg"], ["2.jpg", "1.jpg"], ["1.jpg", "2.jpg"]),
        (["a/1.jpg", "b/1.jpg"], ["/data/db/a/1.jpg", "/data/db/b/1.jpg"], ["/data/db/a/1.jpg", "/data/db/b/1.jpg"]),
        (["a/1.jpg"], ["a/1", "a/2"], ["a/1"]),
        (["a/1.jpg"], ["a/1.png", "1.jpg"], ["1.jpg"]),  # the suffix as well, before without
        (["a/1.JPG"], ["a/1.tiff"], ["a/1.tiff"]),
        (["@5.25@4.50@.jpg"], ["@5.25@4.50@", "@5.25@4.50"], ["@5.25@4.50@"]),
        (["a/1.jpg"], ["b/1.jpg"], [None]),  # another folder is another image
        (["img.jpg", "img.1.jpg"], ["img.1"], [None, "img.1"]),  # stems may hold dots
        (["img.1.jpg"], ["img"], [None]),
        (["a/1.jpg", "b/1.jpg"], ["a/1.jpg", "1.png.h5"], ["a/1.jpg", None]),
        (["1.jpg", "x/1.jpg"], ["1.jpg"], ["1.jpg", None]),  # what is matched whole is not matched again
        (["a\udce9.jpg"], ["a\udce9.jpg"], ["a\udce9.jpg"]),  # bytes that are no UTF-8 ...
        (["a\udce9.jpg"], [r"a\udce9.jpg"], [r"a\udce9.jpg"]),  # ... as text can hold them
        (["a\udce9.jpg"], ["a\udce9.jpg", r"a\udce9.jpg"], ["a\udce9.jpg"]),  # bytes and text in one file
        ([r"a\udce9.jpg"], ["a\udce9.jpg", r"a\udce9.jpg"], [r"a\udce9.jpg"]),
        (["1.jpg", "2.jpg"], ["1.jpg", "query/2.jpg"], ["1.jpg", None]),  # one prefix for all images
        (["1.jpg", "2.jpg"], ["db/1.jpg", "db/2", "query/2"], ["db/1.jpg", "db/2"]),
        ([], ["a.jpg"], []),
    ],
)
def test_matches(names, foreign, expected):
    assert match_names(FILE, names, foreign) == expected


@pytest.mark.parametrize(
    "names, foreign",
    [
        (["1.jpg"], ["db/1.jpg", "query/1.jpg"]),
        (["a/1.jpg", "b/1.jpg"], ["1.jpg"]),
        (["1.jpg", "1.png"], ["1"]),
        (["1.jpg", "2.jpg"], ["1", "query/2.jpg"]),
        (["1.jpg"], ["1.png", "1"]),
        (["0.jpg", "1.jpg", "2.jpg"], ["db/0.jpg", "db/1.jpg", "query/2.jpg"]),
        (["a/1.jpg", "b/2.jpg"], ["1.jpg", "2.jpg"]),
    ],
)
def test_nothing_is_guessed(names, foreign):
    with one_line_error(r"feats\.h5: expected one name for each image, and one prefix .* got .* for "):
        match_names(FILE, names, foreign)


@pytest.mark.parametrize("names", [["a.jpg", "b.jpg", "a.jpg"], ["\udcff.jpg", r"\udcff.jpg"]])
def test_a_name_twice(tmp_path, names):
    """Bytes that are no UTF-8, and the text that stands for them in a file, are one name."""
    features = [(row, feature(row, count=3)) for row in range(len(names))]
    ones = np.ones((len(names), 1))
    shortlist = Shortlist(indices=np.zeros((len(names), 1), int), scores=ones, mask=ones > 0)
    for use in (
        lambda: match_names(FILE, names, names),
        lambda: write_features(tmp_path / "a.h5", names, features),
        lambda: write_features(tmp_path / "a.npz", names, features),
        lambda: write_global_descriptors(tmp_path / "a.h5", names, np.eye(len(names))),
        lambda: write_shortlist(tmp_path / "a.txt", shortlist, names, ["d.jpg"]),
    ):
        with pytest.raises(InputError, match=r"names, got (a|\\udcff)\.jpg twice"):
            use()
    assert not list(tmp_path.iterdir())


paths = st.lists(st.sampled_from(["a", "b", "1.png", "1.jpg", "1.1", "2"]), min_size=1, max_size=3).map("/".join)


@given(st.lists(paths, unique=True, max_size=5), st.lists(paths, unique=True, max_size=5))
def test_whatever_is_matched_is_called_so_alone(names, foreign):
    try:
        matched = match_names(FILE, names, foreign)
    except InputError:
        return
    matches = [name for name in matched if name is not None]
    assert len(set(matches)) == len(matches)
    pairs = [(name.split("/"), other.split("/")) for name, other in zip(names, matched, strict=True) if other]
    shared = [(ours, theirs, min(len(ours), len(theirs))) for ours, theirs in pairs]
    assert len({(*ours[: len(ours) - n], "|", *theirs[: len(theirs) - n]) for ours, theirs, n in shared}) <= 1
    for name, other in zip(names, matched, strict=True):
        assert (other == name) if name in foreign else True
        if other is not None:
            ours, theirs = (text.removesuffix(".png").removesuffix(".jpg") for text in (name, other))
            shorter = min(len(ours.split("/")), len(theirs.split("/")))
            tails = [text.split("/")[-shorter:] for text in (ours, theirs)]
            assert tails[0] == tails[1] or name.split("/")[-shorter:] == other.split("/")[-shorter:]
