"""Which rows a store has on disk, and in which folder each is: its own, or that of a shard."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SHARDS = "shards"  # the folder of a store in which each shard has its own
_ROW = re.compile(r"(0|[1-9]\d{0,8})-(0|[1-9]\d{0,8})\.npz")


@dataclass(frozen=True)
class Places:
    """Rows of a store.

    Attributes:
        counts: `[M]` int32 entries of each row, -1 = not done.
        folders: in which rows may be.
        where: `[M]` int16 which of them each row is in.
    """

    counts: np.ndarray
    folders: list[Path]
    where: np.ndarray

    def path(self, row: int) -> Path:
        """The file of a row that is done."""
        return self.folders[self.where[row]] / f"{row}-{self.counts[row]}.npz"

    def add(self, row: int, count: int, folder: Path) -> Path:
        """The file of a row that is about to be done, in one of the folders."""
        self.where[row] = self.folders.index(folder)
        return folder / f"{row}-{count}.npz"


def places(folder: Path, num_rows: int, *, own: Path, known: bool) -> Places:
    """As the names of the files tell.

    Args:
        folder: of the store.
        num_rows: M.
        own: where rows are written.
        known: whether there is a store yet; else none are done.
    """
    folders = [folder, *sorted({own, *_shards(folder)} - {folder})]
    found = Places(np.full(num_rows, -1, np.int32), folders, np.zeros(num_rows, np.int16))
    for number, one in enumerate(folders if known else ()):
        for path in one.iterdir() if one.is_dir() else ():
            if name := _ROW.fullmatch(path.name):
                row, count = map(int, name.groups())
                if row < num_rows:
                    found.counts[row], found.where[row] = count, number
    return found


def _shards(folder: Path) -> list[Path]:
    return [path for path in (folder / SHARDS).glob("*-of-*") if path.is_dir()]
