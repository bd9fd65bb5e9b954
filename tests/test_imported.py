"""What belongs to which folder of images, and what is missing, of files of other programs."""

from types import SimpleNamespace

import pytest

from experiments import build
from experiments.settings import SettingsError
from mfvpr.archive import Archive
from mfvpr.data.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.errors import InputError
from mfvpr.imported import DescriptorFiles, FeatureFiles, File, ShortlistFiles


def folder(root, count=3):
    return ImageFolder(root, tuple(f"{row}.png" for row in range(count)))


@pytest.mark.parametrize(
    "read",
    [
        lambda files, other: FeatureFiles(files).opened(other, partial=False),
        lambda files, other: DescriptorFiles(files).shortlist(QuerySequence("a", other, None), other, 2, Archive()),
        lambda files, other: ShortlistFiles(files).shortlist(QuerySequence("a", other, None), other, 2, Archive()),
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
    for group, made, own in (("features", build.extractor, {"image_size": None}),
                             ("retrieval", lambda *options: build.filter(*options[:1], SimpleNamespace(), data),
                              {"whiten": None})):  # fmt: skip
        settings = {"name": "import"} | common | own | change
        if not refused:
            assert made(settings, data).files == {tmp_path: File(build.expanded("a.h5"))}
            continue
        with pytest.raises(SettingsError, match=rf"^{group}\.queries={refused}: .*file .*prefix"):
            made(settings, data)
