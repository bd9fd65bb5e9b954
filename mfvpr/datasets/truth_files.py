"""Ground truth from files: pairs of images, positions, or labels. No code in the files is executed."""

import csv
import json
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mfvpr.datasets.ground_truth import FrameTruth, LabelTruth, RadiusTruth, Truth, require_positions
from mfvpr.io.containers import choose_reader, read_npz, reading, shorten
from mfvpr.io.names import require_all
from mfvpr.utils.errors import InputError

_LINES = "lines (with an empty cell if it has no place or label)"
_reading = partial(reading, kind="a ground truth file", mend="see mfvpr/datasets/README.md")


def truth_from_labels(
    query_file: Path | str, database_file: Path | str, query_names: Sequence[str], database_names: Sequence[str]
) -> LabelTruth:
    """Ground truth by equal labels, from a csv with the columns `name,label` for each side, one line per image.

    A query with an empty label has no correct database image, and a database image with an empty label is never
    correct. Labels are compared as text, without spaces around them.
    """
    sides = []
    for path, names in ((Path(query_file), query_names), (Path(database_file), database_names)):
        with _reading(path):
            lines = _csv_columns(path, choices=(("name", "label"),))
        table, labels = _row_table(names), dict[int, str]()
        for number, (name, label) in enumerate(lines, start=1):
            row = table.get(name.strip())
            if row is None or row in labels:
                got = f"{shorten(name)!r} {'again' if row in labels else ', which none or several have'}"
                raise InputError(f"{path}: entry {number}: expected the path of an image, each once, got {got}")
            labels[row] = label.strip()
        sides.append(require_all(path, names, [labels.get(row) for row in range(len(names))], _LINES))
    numbers = {"": -1} | {label: number for number, label in enumerate(sorted({*sides[0], *sides[1]} - {""}))}
    return LabelTruth(*(np.array([numbers[label] for label in side], np.int32) for side in sides))


def truth_from_file(
    path: Path | str, query_names: Sequence[str], database_names: Sequence[str], *, widened: bool = False
) -> Truth:
    """Ground truth from an index file.

    * `.csv`: a header with the columns `query` and `database` (or SSM-VPR's `Live` and `Reference`), then one line per
      pair: file names, or numbers from 0 in file order. A query may have several lines; an empty database cell means
      that its place is not in the database.
    * `.npz`: arrays `query` and `database`, the same pairs; or Patch-NetVLAD's `utmQ` and `utmDb`.
    * `.json`: VPR-Bench's `[[query, [database, ...]], ...]`.

    If `widened`, database images within a tolerance in frames count as well, for databases that are sequences.
    """
    path = Path(path)
    csv_pairs = partial(_csv_columns, choices=(("query", "database"), ("live", "reference")))
    with _reading(path):
        content = choose_reader(path, {".csv": csv_pairs, ".npz": _npz_pairs, ".json": _json_pairs})(path)
    if isinstance(content, dict):
        for (name, xy), images in zip(content.items(), (query_names, database_names), strict=True):
            require_positions(f"{path}: {name}", xy, len(images))
        return RadiusTruth(*content.values())
    sides = ("query", query_names, _row_table(query_names)), ("database", database_names, _row_table(database_names))
    rows: dict[int, list[int]] = {}
    for line, pair in enumerate(content, start=1):
        places: list[int] = []
        for (side, names, table), value in zip(sides, pair, strict=True):
            text = str(value).strip()
            text = text.lstrip("0") or "0" if text.isdecimal() else text
            if side == "database" and not text:
                continue
            if text not in table:
                expected = f"the name of a {side} image or a number from 0 to {len(names) - 1}"
                raise InputError(f"{path}: pair {line}: expected {expected}, got {shorten(text)!r}")
            places.append(table[text])
        rows.setdefault(places[0], []).extend(places[1:])
    places_by_query = require_all(path, query_names, [rows.get(row) for row in range(len(query_names))], _LINES)
    return FrameTruth(tuple(map(tuple, places_by_query)), len(database_names), widened)


def _csv_columns(path: Path, choices: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Cells of the first of several pairs of columns that a csv has."""
    with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:  # as file names are decoded
        lines = csv.reader(file)
        names = [name.strip().lower() for name in next(lines, [])]
        for pair in choices:
            if all(names.count(column) == 1 for column in pair):
                first, second = map(names.index, pair)
                padding = [""] * len(names)  # missing cells at the end of a line are empty
                return [((line + padding)[first], (line + padding)[second]) for line in lines if line]
    got = shorten(",".join(names)) or "no header"
    raise InputError(f"{path}: expected a header with the columns {','.join(choices[0])}; got {got}")


def _npz_pairs(path: Path) -> list[tuple[Any, Any]] | dict[str, np.ndarray]:
    arrays = read_npz(path, ("utmQ", "utmDb", "query", "database"))
    if {"utmQ", "utmDb"} <= arrays.keys():
        return {name: arrays[name].astype(np.float64) for name in ("utmQ", "utmDb")}
    if {"query", "database"} <= arrays.keys():
        return list(zip(arrays["query"].tolist(), arrays["database"].tolist(), strict=True))
    got = shorten(", ".join(arrays)) or "neither"
    raise InputError(f"{path}: expected arrays query and database, or utmQ and utmDb; got {got}")


def _json_pairs(path: Path) -> list[tuple[Any, Any]]:
    entries = json.loads(path.read_text(encoding="utf-8"))
    if not all(isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list) for entry in entries):
        raise InputError(f"{path}: expected [[query, [database, ...]], ...] as in VPR-Bench")
    return [(query, place) for query, places in entries for place in (places or [""])]


def _row_table(names: Sequence[str]) -> dict[str, int]:
    """Rows by number, by unique file names, and by relative path, which counts first."""
    bases = [PurePosixPath(name).name for name in names]
    counts = Counter(bases)
    table = {str(row): row for row in range(len(names))}
    table |= {base: row for row, base in enumerate(bases) if counts[base] == 1}
    return table | {name: row for row, name in enumerate(names)}
