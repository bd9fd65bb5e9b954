"""The images of a map that this process knows: names, places and global descriptors in memory, features on demand."""

import threading
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from mfvpr.features.extractor import Aggregation, Extractor
from mfvpr.features.vlad import VladFitting
from mfvpr.localization.describing import Describing
from mfvpr.localization.evidence import MapStrength
from mfvpr.localization.resident import Resident
from mfvpr.localization.vectors import Vectors
from mfvpr.localization.vocabulary import VocabularyFile
from mfvpr.storage.map_entries import Entry
from mfvpr.storage.maps import MapRows, has_settings
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import recipe_of

Method = TypeVar("Method", bound=Callable[..., Any])


def exclusive(method: Method) -> Method:
    """Let one thread at a time run a method of a map."""

    @wraps(method)
    def run(self: "MapState", *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return run  # pyright: ignore[reportReturnType]  # of the same arguments


class DescribedMap(NamedTuple):
    """The parts of a map that depend on its describer: descriptions, rows on disk and on the device, mean strength."""

    describing: Describing
    rows: MapRows
    resident: Resident
    strength: MapStrength


class MapState:
    """A map that is open: the base of `mfvpr.localization.Map`."""

    def __init__(
        self,
        folder: Path | str,
        extractor: Extractor,
        describer: Extractor | Aggregation | VladFitting,
        *,
        candidates: int,
        memory: float | None,
    ) -> None:
        """Open a map; see `mfvpr.localization.Map`."""
        self.folder = Path(folder).absolute()  # the working directory may change
        self.extractor, self.candidates = extractor, candidates
        self._vectors = Vectors()
        self._entries: dict[int, Entry] = {}  # without vectors
        self._row_of_name: dict[str, int] = {}
        self._resident_options = {"candidates": candidates, "memory": memory}
        self._settings = {"extractor": recipe_of(extractor), "describer": recipe_of(describer)}
        self._is_settled = False  # whether these settings are known to be the folder's
        self._lock = threading.RLock()
        self._vocabulary: VocabularyFile | None = None
        self._described: DescribedMap | None = None  # until there is a vocabulary
        if isinstance(describer, VladFitting):
            self._vocabulary = VocabularyFile(self.folder, extractor, describer)
        else:
            self._use(describer)
        self.refresh()

    def __len__(self) -> int:
        """Number of images."""
        return len(self._entries)

    @property
    def describing(self) -> Describing:
        """The extractor and the describer of the images.

        Raises:
            InputError: the map has no vocabulary yet.
        """
        return self._require_described().describing

    @property
    @exclusive
    def names(self) -> list[str]:
        """Names of the images, in the order of their rows."""
        return [self._entries[row].name for row in sorted(self._entries)]

    @property
    @exclusive
    def there(self) -> np.ndarray:
        """`[rows]` bool, which rows have an image: a process that was killed may have left some out."""
        has_image = np.zeros(self._vectors.total, bool)
        has_image[np.fromiter(self._entries, int, len(self))] = True
        return has_image

    def row(self, name: str) -> int | None:
        """Row of an image; None = the map has no image of this name."""
        return self._row_of_name.get(name)

    def place(self, row: int) -> Any:
        """Place of the image in a row that has one."""
        return self._entries[row].place

    @exclusive
    def refresh(self) -> int:
        """Read the images that other processes added since; return their number.

        Raises:
            InputError: the map was made with other settings, is damaged, or was replaced since it was opened.
        """
        before = len(self)
        self._is_settled = self._is_settled or has_settings(self.folder, self._settings)
        if self._vocabulary is not None and self._described is not None:
            self._vocabulary.check_unchanged()
        elif self._vocabulary is not None and (vocabulary := self._vocabulary.find()) is not None:
            self._use(vocabulary)
        for row, entry in self._described.rows.new() if self._described else ():
            self._vectors.put(row, entry.vector)
            self._entries[row] = entry._replace(vector=None)
            self._row_of_name[entry.name] = row
        return len(self) - before

    def _use(self, describer: Extractor | Aggregation) -> None:
        """Open the rows, which are described by `describer`."""
        describing = Describing(self.extractor, describer)
        rows = MapRows(self.folder, describing.recipe)
        typical = self.extractor.scales[0].typical_count
        resident = Resident(rows, typical=typical, **self._resident_options)
        self._described = DescribedMap(describing, rows, resident, MapStrength(rows))

    def _require_described(self) -> DescribedMap:
        if self._described is None:
            raise InputError(f"{self.folder}: this map has no vocabulary yet; learn it from some images first "
                             "(`learn`)")  # fmt: skip
        return self._described
