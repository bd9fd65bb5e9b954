"""File names for the names that users give to systems, sequences and images."""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence

from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint

_MOST_BYTES = 200  # a file system takes 255, and `replacing` adds some
_PLAIN = re.compile(r'(?!\.)[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]*[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff. ]')
_HASHED = re.compile(r".*-[0-9a-f]{16}", re.IGNORECASE | re.DOTALL)


def file_names(names: Sequence[str]) -> dict[str, str]:
    """File names without suffix, by name; they differ even if the file system ignores case.

    A file name is the name with `_` for ` + `. It ends in a hash instead if the name is not safe on every file system,
    too long, or the same as another.

    Raises:
        InputError: a name is repeated.
    """
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"names: expected different ones, got {repeated[0]} twice. Rename one.")
    plain = {name: name.replace(" + ", "_") for name in names}
    counts = Counter(map(_fold_case, plain.values()))
    files = {}
    for name, file in plain.items():
        is_safe = _PLAIN.fullmatch(file) and not _HASHED.fullmatch(file) and len(file.encode()) <= _MOST_BYTES
        hashed = f"{re.sub('[^A-Za-z0-9]+', '_', name)[:60]}-{fingerprint(name)}"
        files[name] = file if is_safe and counts[_fold_case(file)] == 1 else hashed
    return files


def _fold_case(file: str) -> str:
    return unicodedata.normalize("NFC", file.casefold())
