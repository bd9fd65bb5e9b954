"""Arrays by name <-> bytes of an `.npz` file, and features and matches <-> arrays by name.

Features: `keypoints` float32 `[N, 2]` (px), `descriptors` float16 `[N, D]` of unit length but for rounding, `scales`
float32 `[N]` that restore their lengths, `scores` float32 `[N]` and `image_size` float32 `[2]` (px), without padding.
They are read as float32: the directions of descriptors change by up to 5e-4, everything else is unchanged.

Matches of a query with its candidates: the fields of QueryMatches and of its Matches by name, except fields that are
None. They come back to the bit.
"""

import io
import struct
import threading
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache

import numpy as np

from mfvpr.core.types import Features, Matches
from mfvpr.matchers.match_set import QueryMatches
from mfvpr.utils.errors import InputError

_OF_QUERY = ("counts", "indices", "filter_scores")
_OF_MATCHES = tuple(part.name for part in fields(Matches) if part.name != "mask")  # there is no padding
# NumPy reads the headers of arrays by `ast.parse`, which sometimes fails when several threads call it at the same time
# (SystemError: AST constructor recursion depth mismatch; Python 3.11).
_PARSING = threading.Lock()


def pack_arrays(arrays: Mapping[str, np.ndarray], *, compress: bool = False) -> bytes:
    """The content of an `.npz` file, which `numpy.load` reads as well; `compress` is for repeated values."""
    buffer = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def unpack_arrays(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of `pack_arrays`; an `InputError` if they are damaged: the archive has a checksum of each."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.namelist():
                values = archive.read(member)
                start = 10 + int.from_bytes(values[8:10], "little")  # of the values, in the format's version 1
                shape, is_fortran, dtype = _header(values[:start])
                array = np.frombuffer(values, dtype, offset=start).reshape(shape, order="F" if is_fortran else "C")
                arrays[member.removesuffix(".npy")] = array.copy()  # that may be written to
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError, ValueError):
        raise InputError("expected arrays as they were written here, got damaged ones") from None
    return arrays


@lru_cache(256)
def _header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The header of an array, cached: the files of a cache have few different ones, and NumPy reads them slowly."""
    with _PARSING:
        return np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))


def pack_features(features: Features) -> dict[str, np.ndarray]:
    """Arrays of the features `[N, ...]` of an image; a ValueError if they are not finite."""
    mask = np.asarray(features.mask)
    keypoints, descriptors, scores = (
        np.asarray(values, np.float32)[mask] for values in (features.keypoints, features.descriptors, features.scores)
    )
    lengths = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64)).astype(np.float32)
    image_size = np.asarray(features.image_size, np.float32)
    if not all(np.isfinite(part).all() for part in (keypoints, lengths, scores, image_size)):
        raise ValueError("features must be finite")
    directions = (descriptors / np.where(lengths > 0, lengths, 1)[:, None]).astype(np.float16)
    norms = np.sqrt(np.einsum("nd,nd->n", directions, directions, dtype=np.float32))
    return {
        "keypoints": keypoints,
        "descriptors": directions,
        "scales": lengths / np.where(norms > 0, norms, 1),
        "scores": scores,
        "image_size": image_size,
    }


def unpack_features(arrays: Mapping[str, np.ndarray]) -> Features:
    """The features of `pack_features`."""
    descriptors = arrays["descriptors"].astype(np.float32)
    descriptors *= arrays["scales"][:, None]
    mask = np.ones(len(descriptors), bool)
    return Features(arrays["keypoints"], descriptors, arrays["scores"], mask, arrays["image_size"])


def round_as_stored(features: Features) -> Features:
    """Features `[N, ...]` as they come back from a file: without padding, descriptors to 5e-4."""
    return unpack_features(pack_features(features))


def pack_matches(query: QueryMatches) -> dict[str, np.ndarray]:
    """Arrays of the matches of a query."""
    arrays = {name: getattr(query.matches, name) for name in _OF_MATCHES}
    arrays |= {name: getattr(query, name) for name in _OF_QUERY}
    return {name: np.asarray(values) for name, values in arrays.items() if values is not None}


def unpack_matches(arrays: Mapping[str, np.ndarray]) -> QueryMatches:
    """The matches of `pack_matches`."""
    of_matches = {name: values for name, values in arrays.items() if name in _OF_MATCHES}
    matches = Matches(mask=np.ones(len(arrays["points0"]), bool), **of_matches)
    return QueryMatches(matches, *(arrays[name] for name in _OF_QUERY))
