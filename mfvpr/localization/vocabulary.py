"""The vocabulary of a map whose global descriptors are VLAD: one file in the folder of the map, learned once."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.features.extractor import Extractor
from mfvpr.features.feature_set import FeatureSet
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.storage.disk import disk_errors_as_input_errors
from mfvpr.storage.maps import MAP, file_stamp, has_rows, write_settings
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_VOCABULARY = "vocabulary.npz"


class VocabularyFile:
    """The vocabulary of one map."""

    def __init__(self, folder: Path, extractor: Extractor, fitting: VladFitting) -> None:
        self._folder, self._path = folder, folder / _VOCABULARY
        self._extractor, self._fitting = extractor, fitting
        self._key = fingerprint({"extractor": recipe_of(extractor), "vocabulary": recipe_of(fitting)})
        self._stamp = None  # of the file that was read

    def find(self) -> Vlad | None:
        """Read the vocabulary; None if it is not learned yet. Raises `InputError` if rows lack it, and as `read`."""
        expects_vocabulary = has_rows(self._folder)  # looked at first: another process may be making the map
        if self._path.exists():
            return self.read()
        if expects_vocabulary:
            raise InputError(f"{self._path}: expected the vocabulary of the rows, got none. Put it back.")
        return None

    def read(self) -> Vlad:
        """Read the vocabulary; raises `InputError` if it is missing or damaged, or has other settings."""
        self._stamp = file_stamp(self._path)  # first: a file that replaces this one is noticed
        try:
            arrays = read_arrays(self._path, self._key)
        except InputError:
            raise InputError(
                f"{self._path}: expected the vocabulary that {self._fitting} learned from features of "
                f"{type(self._extractor).__name__} with these settings, got another or a damaged one. Use the "
                "extractor and the settings that the map was made with, or put a copy of the file back."
            ) from None
        return Vlad(arrays["centers"], float(arrays["power"]))

    def check_unchanged(self) -> None:
        """Raise `InputError` if the file was replaced or removed since it was read."""
        if file_stamp(self._path) != self._stamp:
            raise InputError(f"{self._path}: expected the file that the map was opened with, got one that replaced it, "
                             "or none. Open the map again.")  # fmt: skip

    def learn(self, features: FeatureSet, settings: Mapping[str, Any]) -> None:
        """Learn and write the vocabulary of a map with these settings, within `lock_map`."""
        vocabulary = self._fitting.fit(features)
        write_settings(self._folder, settings)
        with disk_errors_as_input_errors(self._folder, MAP.content):
            arrays = {"centers": vocabulary.centers, "power": np.array(vocabulary.power)}
            write_arrays(self._path, arrays, self._key)
