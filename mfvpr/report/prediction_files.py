"""Predictions as files of other programs: candidates, trajectories, and a table of shifts with times."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.positives import Positives
from mfvpr.io.containers import reading, shorten
from mfvpr.io.shortlists import write_shortlist
from mfvpr.io.trajectories import SECOND, read_poses, write_trajectory
from mfvpr.report.evaluations import NO_PLACE
from mfvpr.report.runs import read_csv, write_csv
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable

CandidateLayout = Literal["preds", "hloc", "kapture"]
_NUMBERS = ("confidence", "shift_x", "shift_y", "low_x", "low_y", "high_x", "high_y", "image_width")
_CELLS = (*_NUMBERS, "reason")
SHIFT_COLUMNS = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "place", *_CELLS, "image")
_FRAME = "camera"  # header.frame_id


@dataclass(frozen=True)
class LocalizedImage:
    """A query with its prediction."""

    name: str
    place: Any = None  # any JSON value; None = no place
    candidates: Sequence[tuple[str, float]] = ()  # names of database images and scores, best first; none without place
    cells: Mapping[str, str] = field(default_factory=dict)  # of the table of shifts, by column


def write_candidates(
    path: Path | str,
    shortlist: Shortlist,
    queries: ImageFolder,
    database: ImageFolder,
    layout: CandidateLayout,
    positives: Positives | None = None,
    *,
    prefixes: tuple[str, str] = ("", ""),
) -> None:
    """Write candidates as `mfvpr.io.write_shortlist`; `preds` has full paths, and the correct images if known.

    Other layouts have `prefixes` before the names of queries and database images.
    """
    names = [[prefix + name for name in side.names] for side, prefix in zip((queries, database), prefixes, strict=True)]
    if layout == "preds":
        names = [[os.path.abspath(path) for path in side.paths] for side in (queries, database)]
    correct = None if positives is None else [positives.of(row).tolist() for row in range(len(queries))]
    write_shortlist(path, shortlist, *names, layout=layout, positives=correct)


def write_poses(
    path: Path | str,
    images: Sequence[LocalizedImage],
    poses: Path,
    database: Sequence[str],
    stamps: Sequence[int] | None,
) -> None:
    """Write the pose of each first candidate, as `mfvpr.io.write_trajectory`; `stamps` None = KITTI.

    `poses` is a file of the `database` images, as `mfvpr.io.read_poses` reads it.
    """
    by_name = dict(zip(database, read_poses(poses, database), strict=True))
    texts = []
    for image in images:
        name = image.candidates[0][0] if image.candidates else None
        if image.place is not None and name not in by_name:
            words = "localize with alternatives=1 or more, and name the folder of the database"
            raise InputError(f"{shorten(image.name)}: expected a database image with a pose, got {name}; {words}")
        texts.append(None if image.place is None or name is None else by_name[name])
    write_trajectory(path, texts, stamps)


def write_shift_table(path: Path, images: Sequence[LocalizedImage], stamps: Sequence[int]) -> None:
    """Write a CSV line per image with `SHIFT_COLUMNS`, in the order of the times `stamps` (ns), as ROS names them.

    The file must be new. Unknown numbers, and the place of an image without one, are empty cells.
    """
    require_replaceable(path)
    lines = []
    for row in sorted(range(len(images)), key=stamps.__getitem__):
        place, cells = images[row].place, [images[row].cells.get(name, "") for name in _CELLS]
        text = "" if place is None else place if isinstance(place, str) else json.dumps(place, ensure_ascii=False)
        lines.append([stamps[row] // SECOND, stamps[row] % SECOND, _FRAME, text, *cells, images[row].name])
    write_csv(path, SHIFT_COLUMNS, lines)


def shortlist_of(images: Sequence[LocalizedImage], database: Sequence[str]) -> Shortlist:
    """Candidates `[Q, C]` of localized images."""
    rows = {name: row for row, name in enumerate(database)}
    depth = max((len(image.candidates) for image in images), default=0)
    indices, scores = np.full((len(images), depth), -1, np.int32), np.zeros((len(images), depth), np.float32)
    for query, image in enumerate(images):
        for rank, (name, score) in enumerate(image.candidates):
            if name not in rows:
                raise InputError(f"{shorten(name)}: expected an image of the database; the data set has changed")
            indices[query, rank], scores[query, rank] = rows[name], score
    return Shortlist(indices=indices, scores=scores, mask=indices >= 0)


def read_lines(path: Path) -> list[LocalizedImage]:
    """Read the lines of `mfvpr localize`; an image that could not be read has no place, and its error as reason."""
    images = []
    with reading(path, mend="expected lines of mfvpr localize"):
        for line in filter(str.strip, path.read_text(encoding="utf-8").split("\n")):
            values = json.loads(line)
            if "error" in values:
                images.append(LocalizedImage(values["image"], cells={"reason": values["error"]}))
                continue
            low, high = values["shift_interval"] or [[None, None]] * 2
            numbers = [values["confidence"], *(values["shift"] or [None] * 2), *low, *high, values["image_width"]]
            cells = {name: str(number) for name, number in zip(_NUMBERS, numbers, strict=True) if number is not None}
            candidates = [(each["name"], each["score"]) for each in values["alternatives"]]
            if values["place"] is None:
                cells, candidates = cells | {"reason": values["reason"]}, []
            images.append(LocalizedImage(values["image"], values["place"], candidates, cells))
    return images


def read_run_images(folder: Path, queries: Sequence[str]) -> list[LocalizedImage]:
    """Localized images of a sequence of an evaluation, from the files in its folder; refused queries have no place."""
    candidates, cells = ({query: [] for query in queries}, {query: {} for query in queries})
    with reading(folder / "predictions.csv", mend="expected the folder of an evaluation, of this data set"):
        for row in read_csv(folder / "predictions.csv"):
            if row["database"] != NO_PLACE:
                candidates[row["query"]].append((row["database"], float(row["score"])))
        for path in (folder / "top_predictions.csv", folder / "shifts.csv"):
            for row in read_csv(path) if path.exists() else ():
                row["image_width"] = row.get("width", "")
                cells[row["query"]] |= {name: row[name] for name in _CELLS if row.get(name)}
    places = {query: names[0][0] if names else None for query, names in candidates.items()}
    return [LocalizedImage(query, places[query], candidates[query], cells[query]) for query in queries]
