"""Files of other programs: which entry belongs to which folder of images, and what is missing."""

from types import SimpleNamespace

import numpy as np
import pytest

from mfvpr.datasets import Dataset, ImageFolder, Positives, QuerySequence
from mfvpr.io import write_features, write_global_descriptors
from mfvpr.retrieval import DescriptorFiles, FeatureFiles, ShortlistFiles
from mfvpr.retrieval.precomputed import File
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user
from tests.io.other_programs import feature


def folder(root, count=3):
    return ImageFolder(root, tuple(f"{row}.png" for row in range(count)))


def list_candidates(source, queries, database):
    """Rows of the first query's candidates."""
    retrieved = source.shortlist(QuerySequence("q", queries, None), database, 1, FeatureCache())
    return retrieved.candidates.indices[0].tolist()


@pytest.mark.parametrize(
    "read",
    [
        lambda files, other: FeatureFiles(files).open(other, partial=False),
        lambda files, other: list_candidates(DescriptorFiles(files), other, other),
        lambda files, other: list_candidates(ShortlistFiles(files), other, other),
    ],
)
def test_a_folder_without_a_file_is_refused_with_those_that_have_one(tmp_path, read):
    with pytest.raises(InputError, match=r"/other: .*one of: .*/known; "):
        read({tmp_path / "known": File(tmp_path / "a.npz")}, folder(tmp_path / "other"))


@pytest.mark.parametrize(
    ("change", "refused"), [({"queries": "b.h5"}, "b.h5"), ({"query_prefix": "q/"}, "a.h5"), ({}, "")]
)
def test_two_files_of_one_folder_are_refused(tmp_path, change, refused):
    """The second would be read for the database as well."""
    same = folder(tmp_path)
    data = Dataset("same", same, (QuerySequence("same", same, None),))
    common = {"database": "a.h5", "queries": "a.h5", "database_prefix": "", "query_prefix": "", "lengths": "unit"}
    for group, build_stage, defaults in (
        ("features", assembly.extractor, {"image_size": None}),
        (
            "retrieval",
            lambda *options: assembly.retriever(*options[:1], SimpleNamespace(), data),
            {"whiten": None, "standardize": "none"},
        ),
    ):
        settings = {"name": "import"} | common | defaults | change
        if not refused:
            assert build_stage(settings, data).files == {tmp_path: File(expand_user("a.h5"))}
            continue
        with pytest.raises(InputError, match=rf"^{group}\.queries={refused}: .*file .*prefix"):
            build_stage(settings, data)


def written(root, names, file):
    """Features in a file; global descriptors where the file is called so."""
    if "global" in file:
        write_global_descriptors(root / file, names, np.eye(len(names)))
    else:
        write_features(root / file, names, [(row, feature(row, count=3)) for row in range(len(names))])
    return root / file


def read_both(database, queries, files):
    """Read the database, then the queries."""
    if "global" in files[database.root].path.name:
        return list_candidates(DescriptorFiles(files), queries, database)
    source = FeatureFiles(files)
    return [source.open(folder, partial=False) for folder in (database, queries)]


@pytest.mark.parametrize("file", ["f.h5", "global.npz", "global.npy"])
@pytest.mark.parametrize("prefix", ["", "db/"])
def test_an_entry_is_of_one_image(tmp_path, file, prefix):
    """Queries do not get the features of database images with equal names, also through a link to the file."""
    database, queries = folder(tmp_path / "database"), folder(tmp_path / "queries")
    path = written(tmp_path, [prefix + name for name in database.names], file)
    link = tmp_path / f"link_{file}"
    link.symlink_to(path)
    for other in (path, tmp_path / "x" / ".." / file, link):
        (tmp_path / "x").mkdir(exist_ok=True)
        both = r"(0\.png|row 0) for .*database/0\.png and for .*queries/0\.png; "
        with pytest.raises(InputError, match=both) as error:
            read_both(database, queries, {database.root: File(path), queries.root: File(other)})
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("file", ["f.npz", "global.npz"])
def test_folders_share_a_file_with_different_entries_or_images_of_one_path(tmp_path, file):
    database, queries = folder(tmp_path / "database"), folder(tmp_path / "queries")
    names = [f"{side.root.name}/{name}" for side in (database, queries) for name in side.names]
    path = written(tmp_path, names, file)
    sides = {side.root: File(path, f"{side.root.name}/") for side in (database, queries)}
    assert read_both(database, queries, sides)
    database.root.mkdir()
    (tmp_path / "link").symlink_to(database.root)
    same = folder(tmp_path / "link")
    assert read_both(database, same, sides | {same.root: sides[database.root]})
    assert read_both(database, database, sides)


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_candidates_of_a_file_that_are_excluded_leave_their_place_to_those_behind(tmp_path, depth):
    queries, database = folder(tmp_path / "queries"), folder(tmp_path / "database")
    pairs = "".join(f"{query}.png {row}.png\n" for query, row in ((0, 1), (0, 0), (0, 2), (1, 1), (2, 2), (2, 0)))
    (tmp_path / "pairs.txt").write_text(pairs)
    sequence = QuerySequence("q", queries, None, Positives.from_rows([[1], [1, 2], []], 3))
    files = ShortlistFiles({queries.root: File(tmp_path / "pairs.txt")})
    candidates = files.shortlist(sequence, database, depth, FeatureCache()).candidates
    expected = [(rows + [-1] * 4)[:depth] for rows in ([0, 2], [], [2, 0])]
    assert (candidates.indices.tolist(), candidates.mask.tolist()) == (expected, (np.array(expected) >= 0).tolist())


def test_every_sequence_has_its_file_or_all_have_one(tmp_path):
    sequences = tuple(QuerySequence(name, folder(tmp_path / name), None) for name in "ab")
    data = Dataset("d", folder(tmp_path / "db"), sequences)
    settings = {"name": "pairs", "queries": ["a.txt", "b.txt"], "database_prefix": "", "query_prefix": "q/"}
    for queries, paths in ((["a.txt", "b.txt"], "ab"), (["a.txt"], "aa"), ("a.txt", "aa")):
        source = assembly.retriever(settings | {"queries": queries}, SimpleNamespace(), data)
        assert source.files == {tmp_path / name: File(f"{path}.txt", "q/") for name, path in zip("ab", paths)}  # noqa: B905


def test_pairs_within_the_database_are_not_of_queries(tmp_path):
    """Plain names mean an image on either side, and the names of a prefix that was given do."""
    database, queries = folder(tmp_path / "database"), folder(tmp_path / "queries")
    pairs = tmp_path / "pairs.txt"

    def candidates(names, images=queries, **prefixes):
        pairs.write_text("{} {}\n".format(*names))
        files = ShortlistFiles({images.root: File(pairs, prefixes.get("query", ""))}, prefixes.get("database", ""))
        return list_candidates(files, images, database)

    with pytest.raises(InputError, match=r"db/0\.png for .*database/0\.png and for .*queries/0\.png; "):
        candidates(["db/0.png", "db/0.png"])
    assert candidates(["db/0.png", "db/0.png"], images=database) == [0]
    assert candidates(["db/0.png", "db/0.png"], query="db/", database="db/") == [0]
    assert candidates(["q/0.png", "db/0.png"]) == candidates(["0.png", "0.png"]) == [0]
