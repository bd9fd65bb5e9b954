"""The files of a store's rows, in the folder of the store and in those of its shards."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

SHARDS = "shards"  # the folder of a store in which each shard has its own
_ROW = re.compile(r"(0|[1-9]\d{0,8})-(0|[1-9]\d{0,8})\.npz")


class RowFiles:
    """The rows of a store that are done, known by the names of their files.

    Attributes:
        counts: `[M]` int32 entries of each row, -1 = not done.
    """

    def __init__(self, num_rows: int, folders: Sequence[Path]) -> None:
        """Start without files, in folders that may be missing."""
        self.counts, self._folders = np.full(num_rows, -1, np.int32), folders
        self._folder_of = np.zeros(num_rows, np.int16)  # index of each row's folder

    def find(self) -> None:
        """Find the files in all folders."""
        for number, folder in enumerate(self._folders):
            for path in folder.iterdir() if folder.is_dir() else ():
                if name := _ROW.fullmatch(path.name):
                    row, count = map(int, name.groups())
                    if row < len(self.counts):
                        self.counts[row], self._folder_of[row] = count, number

    def add(self, row: int, count: int, folder: Path) -> None:
        """Add a row that was written into one of the folders."""
        self._folder_of[row] = self._folders.index(folder)
        self.counts[row] = count

    def path(self, row: int) -> Path:
        """The file of a row that is done."""
        return self._folders[self._folder_of[row]] / f"{row}-{self.counts[row]}.npz"
