"""The files of a store's rows, in the folder of the store and in those of its shards."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SHARDS = "shards"  # the folder of a store in which each shard has its own
_ROW = re.compile(r"(0|[1-9]\d{0,8})-(0|[1-9]\d{0,8})\.npz")


@dataclass(frozen=True)
class RowFiles:
    """Rows of a store.

    Attributes:
        counts: `[M]` int32 entries of each row, -1 = not done.
        folders: all that may hold rows.
        folder_of: `[M]` int16 index of each row's folder.
    """

    counts: np.ndarray
    folders: list[Path]
    folder_of: np.ndarray

    def path(self, row: int) -> Path:
        """The file of a row that is done."""
        return self.folders[self.folder_of[row]] / f"{row}-{self.counts[row]}.npz"

    def add(self, row: int, count: int, folder: Path) -> Path:
        """The file of a row that is about to be done, in one of the folders."""
        self.folder_of[row] = self.folders.index(folder)
        return folder / f"{row}-{count}.npz"


def list_rows(folder: Path, num_rows: int, *, write_folder: Path, is_known: bool) -> RowFiles:
    """List the rows that are done, by the names of their files.

    Args:
        folder: of the store.
        num_rows: M.
        write_folder: where rows are written.
        is_known: whether the store exists; else no row is done.
    """
    shards = {path for path in (folder / SHARDS).glob("*-of-*") if path.is_dir()}
    folders = [folder, *sorted({write_folder, *shards} - {folder})]
    files = RowFiles(np.full(num_rows, -1, np.int32), folders, np.zeros(num_rows, np.int16))
    for number, place in enumerate(folders if is_known else ()):
        for path in place.iterdir() if place.is_dir() else ():
            if name := _ROW.fullmatch(path.name):
                row, count = map(int, name.groups())
                if row < num_rows:
                    files.counts[row], files.folder_of[row] = count, number
    return files
