"""Read and write shortlists of other programs: hloc, kapture, VPR-methods-evaluation, To-Match."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mfvpr.core.types import Shortlist
from mfvpr.io.containers import (
    FileEntry,
    adds_folders,
    match_names,
    parse_number,
    read_npz,
    reading,
    require_different,
    shorten,
    write_npz,
)
from mfvpr.io.pair_files import POSITIVES, PREDICTIONS, QUERY, read_num_inliers, read_predictions
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import printable, require_replaceable, write_text

PairLayout = Literal["hloc", "kapture", "preds"]
_SEPARATORS = {"hloc": " \t\n\r", "kapture": ",\n\r", "preds": "\n\r"}  # characters that names must not contain
Entries = list[FileEntry | None]
ScoredPair = tuple[str, str, float | None]  # names of a query and a database image, and the score if the line has one


def read_shortlist(
    path: Path | str,
    query_names: Sequence[str],
    database_names: Sequence[str],
    *,
    num_candidates: int | None = None,
    check_entries: Callable[[Entries, Entries], None] | None = None,
) -> Shortlist:
    """Read the candidates that another program chose; a query's best candidate comes first.

    Args:
        path: `.npz`: `predictions` `[Q, K]`, rows of the database, -1 = none, and optional `scores` `[Q, K]`.
            Other suffixes: lines of text, `query database` as hloc, or `query, reference[, score]` as kapture and
            Patch-NetVLAD's predictions. A folder: `preds` of VPR-methods-evaluation; with To-Match's `.torch` files
            beside its text files, candidates are re-ranked by the number of inliers.
        query_names: `[Q]` relative POSIX paths, matched as in `containers.match_names`.
        database_names: `[N]` likewise.
        num_candidates: C; None = the largest number of a query's candidates.
        check_entries: called with the names of queries `[Q]` and database images `[N]` in a file of names, None unless
            a name has additional folders: a file name alone may mean a query and a database image.

    Returns:
        Shortlist `[Q, C]`, NumPy, -1 if a query has fewer candidates (it may have none). If a query has a candidate
        twice, the first counts. Scores are those of the file, or C for the first candidate, then C - 1, ...

    Raises:
        InputError: a damaged file, unknown or ambiguous names, rows out of range, or scores that are not finite,
            ascend, or are those of some pairs only.
    """
    path = Path(path)
    if num_candidates is not None and num_candidates < 1:
        raise InputError(f"num_candidates={num_candidates}: expected at least 1")
    if path.suffix.lower() == ".npz":
        pairs = _from_npz(path, len(query_names), len(database_names))
    else:
        names = _read_predictions(path) if path.is_dir() else _read_pairs(path)
        queries, query_entries = _rows(path, query_names, (query for query, _, _ in names), "query")
        database, database_entries = _rows(path, database_names, (image for _, image, _ in names), "database")
        pairs = ((queries[query], database[image], score) for query, image, score in names)
        if check_entries is not None:
            check_entries(query_entries, database_entries)
    candidates: list[dict[int, float | None]] = [{} for _ in query_names]  # database rows and scores, best first
    for query, row, score in pairs:
        candidates[query].setdefault(row, score)  # of several scores, the first counts
    if not any(candidates):
        raise InputError(f"{path}: expected candidates of {len(query_names)} queries, got none at all; check the names")
    if len(has_score := {score is not None for rows in candidates for score in rows.values()}) == 2:
        raise InputError(f"{path}: expected scores of all pairs or of none, got some without; write all scores")
    depth = num_candidates or max(map(len, candidates))
    indices = np.full((len(candidates), depth), -1, np.int32)
    scores = np.zeros((len(candidates), depth), np.float32)
    for query, rows in enumerate(candidates):
        count = min(len(rows), depth)
        indices[query, :count] = list(rows)[:count]
        scores[query, :count] = np.arange(depth, depth - count, -1)
        if has_score == {True}:
            scores[query, :count] = _descending(f"{path}: {shorten(query_names[query])}", [*rows.values()])[:count]
    return Shortlist(indices=indices, scores=scores, mask=indices >= 0)


def write_shortlist(
    path: Path | str,
    shortlist: Shortlist,
    query_names: Sequence[str],
    database_names: Sequence[str],
    *,
    layout: PairLayout = "hloc",
    positives: Sequence[Sequence[int]] | None = None,
) -> None:
    """Write a shortlist `[Q, C]` as `read_shortlist` reads it, atomically.

    Args:
        path: `.npz`: `predictions` int32 and `scores` float32 `[Q, C]`; other suffixes: a line for each pair.
        query_names, database_names: `[Q]` and `[N]`; full paths, if another program shall read the images.
        layout: of text. `hloc`: no scores; `kapture`: scores with all digits of float32; `preds`: a new folder `path`
            of VPR-methods-evaluation's predictions, without scores.
        positives: `[Q]` database rows of the correct images of each query, for `preds`; None = not listed.

    Raises:
        InputError: the file exists, names do not fit a line, or written scores are not finite or ascend.
    """
    path = Path(path)
    require_word("layout", layout, PairLayout)
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    if len(indices) != len(query_names):
        raise InputError(f"{path}: expected names of {len(indices)} queries, got {len(query_names)}; name them")
    if indices.max(initial=-1) >= len(database_names):
        raise InputError(f"{path}: expected database rows below {len(database_names)}, got {indices.max()}; name them")
    is_npz = path.suffix.lower() == ".npz"
    for query in range(len(indices)) if is_npz or layout == "kapture" else ():
        _descending(f"{path}: {shorten(query_names[query])}", scores[query][mask[query]])
    if is_npz:
        predictions = np.where(mask, indices, -1).astype(np.int32)
        write_npz(path, {"predictions": predictions, "scores": np.where(mask, scores, 0).astype(np.float32)}.items())
        return
    for names in (query_names, database_names):
        require_different(path, names)
        for name in names:
            if name != name.strip() or name.startswith("#") or {*_SEPARATORS[layout]} & {*name}:
                raise InputError(f"{path}: expected names that fit the layout {layout}, got {name!r}; write .npz")
    require_replaceable(path)
    if layout == "preds":
        path.mkdir(parents=True)
        for row in np.flatnonzero(mask.any(axis=1)).tolist():  # the number of a file is the query's row
            parts = [[QUERY, query_names[row]], [PREDICTIONS, *(database_names[i] for i in indices[row][mask[row]])]]
            if positives is not None:
                parts.append([POSITIVES, *(database_names[int(each)] for each in positives[row])])
            text = "".join("\n".join(part) + "\n\n" for part in parts)  # To-Match needs the last empty line
            write_text(path / f"{row:03d}.txt", text)
        return
    lines = ["# kapture format: 1.0", "# query_image, map_image, score"] if layout == "kapture" else []
    for query, position in np.argwhere(mask).tolist():
        names = [query_names[query], database_names[int(indices[query, position])]]
        score = str(np.float32(scores[query, position]))
        lines.append(" ".join(names) if layout == "hloc" else ", ".join([*names, score]))
    write_text(path, "\n".join(lines) + "\n")


def _from_npz(path: Path, num_queries: int, num_database: int) -> Iterator[tuple[int, int, float | None]]:
    arrays = read_npz(path, ("predictions", "scores"))
    predictions = arrays.get("predictions", np.zeros(0))
    scores = arrays.get("scores", np.full(predictions.shape, None))
    is_valid = predictions.ndim == 2 and predictions.dtype.kind in "iu" and len(predictions) == num_queries
    is_valid = is_valid and ((predictions >= -1) & (predictions < num_database)).all()
    if not is_valid or scores.shape != predictions.shape or scores.dtype.kind not in "fiuO":
        expected = f"predictions [{num_queries}, K], rows from 0 to {num_database - 1} or -1, and as many scores"
        got = f"{predictions.dtype}{[*predictions.shape]} and {scores.dtype}{[*scores.shape]}"
        raise InputError(f"{path}: expected {expected}, got {got}: {shorten(str(predictions))}")
    for query, place in np.argwhere(predictions >= 0).tolist():
        yield query, int(predictions[query, place]), scores[query, place]


def _read_pairs(path: Path) -> list[ScoredPair]:
    """Read the pairs of a text file, in its order: commas or spaces are between the columns."""
    with reading(path, mend="expected a text file of image pairs"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    pairs = []
    for number, line in enumerate(map(str.strip, printable(text).split("\n")), start=1):
        if not line or line.startswith("#"):
            continue
        words = [word.strip() for word in line.split(",")] if "," in line else line.split()
        try:
            query, database, score = words if len(words) == 3 and "," in line else (*words, None)
            pairs.append((query, database, None if score is None else parse_number(score)))
        except ValueError:  # another number of words, or no number
            expected = "'query database', or 'query, database' and a score"
            raise InputError(f"{path}: line {number}: expected {expected}, got {shorten(line)!r}") from None
    return pairs


def _read_predictions(folder: Path) -> list[ScoredPair]:
    """Read the pairs of a folder of predictions."""
    pairs, files = [], dict[str, Path]()
    for path in sorted(folder.glob("*.txt")):
        query, predictions = read_predictions(path)
        if (first := files.setdefault(query, path)) != path:
            raise InputError(f"{path}: expected another query than in {first.name}; remove the files of older runs")
        counts: Any = [None] * len(predictions)
        if (results := path.with_suffix(".torch")).exists():
            counts = read_num_inliers(results, len(predictions))
        scored = zip(predictions, counts, strict=False)  # predictions that were not matched are no candidates
        pairs += [(query, *each) for each in sorted(scored, key=lambda pair: -(pair[1] or 0))]
    if not files:
        raise InputError(f"{folder}: expected text files of predictions, one for each query, got none; check the path")
    return pairs


def _rows(path: Path, names: Sequence[str], foreign: Iterable[str], side: str) -> tuple[dict[str, int], Entries]:
    """Row of each foreign name, and the entry of each image; an InputError for unknown names."""
    foreign = dict.fromkeys(foreign)
    rows = {name: row for row, name in enumerate(match_names(path, names, foreign)) if name is not None}
    if unknown := [name for name in foreign if name not in rows]:
        got = f"{shorten(unknown[0])!r}, which none of the {len(names)} has, or one has by its full path"
        raise InputError(f"{path}: expected the relative path of a {side} image, got {got}")
    entries = {row: FileEntry(path, name) for name, row in rows.items() if adds_folders(names[row], name)}
    return rows, [entries.get(row) for row in range(len(names))]


def _descending(where: str, scores: Any) -> np.ndarray:
    """Scores as float32; raises an InputError unless they are finite and descend, as distances do not."""
    with np.errstate(over="ignore"):
        values = np.array(scores, np.float32)
    if not np.isfinite(values).all() or (np.diff(values) > 0).any():
        got = shorten(str(values))
        raise InputError(f"{where}: expected finite scores that descend, got {got}; negate distances")
    return values
