"""Open the zip files of `torch.save`: a pickle, and an entry for the values of each storage."""

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, NamedTuple

from mfvpr.io.containers import shorten
from mfvpr.io.formats.pickles import file_size
from mfvpr.utils.errors import InputError


class TorchArchive(NamedTuple):
    """An open file of `torch.save`."""

    archive: zipfile.ZipFile
    folder: str  # of its entries, with a slash
    pickle: BinaryIO


@contextmanager
def open_torch_archive(file: BinaryIO) -> Iterator[TorchArchive]:
    """Check an uncompressed file and its checksums.

    Raises:
        InputError: entries are repeated, compressed, or damaged.
        ValueError, zipfile.BadZipFile: it is no file of `torch.save`.
    """
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        packed = any(entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 for entry in entries)
        if packed or len(set(names)) < len(names) or sum(entry.file_size for entry in entries) > file_size(file):
            raise InputError("expected each entry of the zip file once and uncompressed; use the official file")
        if broken := archive.testzip():
            raise InputError(f"the file is damaged, by the checksum of {shorten(broken)}; get it again")
        (pickle,) = (name for name in names if name.split("/")[1:] == ["data.pkl"])
        yield TorchArchive(archive, pickle.removesuffix("data.pkl"), io.BytesIO(archive.read(pickle)))
