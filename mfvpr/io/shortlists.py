"""Read and write shortlists and rankings of other programs.

Lists of image pairs are hloc's `query database` and kapture's `query, reference, score`. VPR-methods-evaluation writes
a folder of predictions, a text file for each query. To-Match adds the results of an image matcher.
"""

import re
from collections.abc import Iterator, Sequence, Set
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np

from mfvpr.core.types import Ranking, Shortlist
from mfvpr.io.checks import parse_number
from mfvpr.io.containers import FileEntry, reading, shorten
from mfvpr.io.formats.predictions import POSITIVES, PREDICTIONS, QUERY, read_num_inliers, read_predictions
from mfvpr.io.names import adds_folders, match_names, require_different
from mfvpr.io.npz import read_npz, write_npz
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import printable, require_file, require_replaceable, write_text

PairLayout = Literal["hloc", "kapture", "preds"]
Candidates = dict[int, float | None]  # database rows and scores of one query, best first
Scored = tuple[int, int, float | None]  # rows of a query and a database image, and their score
_SEPARATOR = re.compile(r"\s*,\s*|\s+")
_MOST_CHARACTERS, _MOST_WORDS = 10_000, 200  # of a line, since every split of it is tried
_HEADINGS = PREDICTIONS, POSITIVES


class Pair(NamedTuple):
    """Names of an image pair, and its score if the line has one."""

    query: str
    database: str
    score: float | None = None


def read_shortlist(
    path: Path | str, query_names: Sequence[str], database_names: Sequence[str], *, num_candidates: int | None = None
) -> Shortlist:
    """Read the candidates that another program chose.

    Args:
        path: `.npz`: `predictions` `[Q, K]`, rows of the database, -1 = none, and optional `scores` `[Q, K]`, in the
            order of `query_names` and `database_names`. Other suffixes: lines of text, `query database` as hloc, or
            `query, reference[, score]` as kapture and Patch-NetVLAD's predictions; # begins a comment. A folder:
            `preds` of VPR-methods-evaluation; with To-Match's `.torch` files beside its text files, candidates are
            re-ranked by the number of inliers. A query's best candidate comes first.
        query_names: `[Q]` relative POSIX paths, matched as in `names.match_names`.
        database_names: `[N]` likewise.
        num_candidates: C; None = the largest number of a query's candidates.

    Returns:
        Shortlist `[Q, C]`, NumPy, -1 if a query has fewer candidates (it may have none). If a query has a candidate
        twice, the first counts. Scores are those of the file, or C for the first candidate, then C - 1, ...

    Raises:
        InputError: the file is missing or damaged; names are unknown or ambiguous; rows are out of range; scores are
            not finite, ascending, or those of some pairs only.
    """
    return read_with_entries(path, query_names, database_names, num_candidates=num_candidates)[0]


def read_with_entries(
    path: Path | str, query_names: Sequence[str], database_names: Sequence[str], *, num_candidates: int | None = None
) -> tuple[Shortlist, list[FileEntry | None], list[FileEntry | None]]:
    """Shortlist as `read_shortlist` returns it, and the entries of queries `[Q]` and database images `[N]`.

    Only names with additional folders are entries: a file name alone may mean a query and a database image.
    """
    path = Path(path)
    if not path.is_dir():
        require_file(path)
    if num_candidates is not None and num_candidates < 1:
        raise InputError(f"num_candidates={num_candidates}: expected at least 1")
    queries, database = {}, {}
    if path.suffix.lower() == ".npz":
        pairs = _from_npz(path, len(query_names), len(database_names))
    else:
        names = _read_predictions(path) if path.is_dir() else _read_pairs(path, query_names, database_names)
        queries = _rows(path, query_names, dict.fromkeys(pair.query for pair in names), "query")
        database = _rows(path, database_names, dict.fromkeys(pair.database for pair in names), "database")
        pairs = ((queries[query], database[image], score) for query, image, score in names)
    candidates: list[Candidates] = [{} for _ in query_names]
    for query, row, score in pairs:
        candidates[query].setdefault(row, score)  # of several scores, the first counts
    if not any(candidates):
        raise InputError(f"{path}: expected candidates of {len(query_names)} queries, got none at all")
    shortlist = _shortlist(path, candidates, query_names, num_candidates)
    return shortlist, _entries(path, query_names, queries), _entries(path, database_names, database)


def write_shortlist(
    path: Path | str,
    shortlist: Shortlist,
    query_names: Sequence[str],
    database_names: Sequence[str],
    *,
    layout: PairLayout = "hloc",
    positives: Sequence[Sequence[int]] | None = None,
) -> None:
    """Write a shortlist as `read_shortlist` reads it, atomically.

    Args:
        path: `.npz`: `predictions` int32 and `scores` float32 `[Q, C]`; other suffixes: a line for each pair.
        shortlist: `[Q, C]`.
        query_names: `[Q]`.
        database_names: `[N]`.
        layout: of text. `hloc`: no scores; `kapture`: scores with all digits of float32; `preds`: a new folder `path`
            of VPR-methods-evaluation's predictions, without scores. Other programs read the images there, if the
            names are full paths.
        positives: `[Q]` database rows of the correct images of each query, for `preds`; None = not listed.

    Raises:
        InputError: the file exists; names are missing or do not fit a line; or written scores are not finite, or
            ascending.
    """
    path = Path(path)
    require_word("layout", layout, PairLayout)
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    if len(indices) != len(query_names):
        raise InputError(f"{path}: expected the names of {len(indices)} queries, got {len(query_names)}")
    if indices.max(initial=-1) >= len(database_names):
        raise InputError(f"{path}: expected database rows below {len(database_names)}, got {indices.max()}")
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
            if name != name.strip() or "\n" in name or "\r" in name:
                raise InputError(f"{path}: expected names of one line without spaces around, got {name!r}; write .npz")
    if layout == "preds":
        lists = [
            [row[real] for row, real in zip(indices, mask, strict=True)],
            *([] if positives is None else [positives]),
        ]
        names = [[[database_names[int(row)] for row in rows] for rows in each] for each in lists]
        _write_predictions(path, query_names, names)
        return
    lines = ["# kapture format: 1.0", "# query_image, map_image, score"] if layout == "kapture" else []
    for query, position in np.argwhere(mask).tolist():
        names = (query_names[query], database_names[int(indices[query, position])])
        score = np.float32(scores[query, position])
        lines.append(" ".join(names) if layout == "hloc" else ", ".join((*names, str(score))))
    require_replaceable(path)
    write_text(path, "\n".join(lines) + "\n")


def reranked_shortlist(shortlist: Shortlist, ranking: Ranking) -> Shortlist:
    """The shortlist in the order of a ranking, with its scores, `[Q, C]`."""
    order = np.asarray(ranking.order)
    parts = (shortlist.indices, ranking.scores, shortlist.mask)
    indices, scores, mask = (np.take_along_axis(np.asarray(part), order, 1) for part in parts)
    return Shortlist(indices=np.where(mask, indices, -1), scores=np.where(mask, scores, 0), mask=mask)


def _from_npz(path: Path, num_queries: int, num_database: int) -> Iterator[Scored]:
    arrays = read_npz(path, ("predictions", "scores"))
    predictions, scores = arrays.get("predictions"), arrays.get("scores")
    if predictions is None or predictions.ndim != 2 or predictions.dtype.kind not in "iu":
        got = "none" if predictions is None else f"{predictions.dtype}{list(predictions.shape)}"
        raise InputError(f"{path}: expected predictions [{num_queries}, K], whole numbers, got {got}")
    if len(predictions) != num_queries:
        raise InputError(f"{path}: expected predictions of {num_queries} queries, got {len(predictions)}")
    wrong = (predictions >= num_database) | (predictions < -1)
    if wrong.any():
        query, position = np.argwhere(wrong)[0].tolist()
        raise InputError(f"{path}: predictions of query {query}: expected database rows from 0 to {num_database - 1}, "
                         f"or -1 for none, got {predictions[query, position]}")  # fmt: skip
    if scores is not None and (scores.shape != predictions.shape or scores.dtype.kind not in "fiu"):
        got = f"{scores.dtype}{list(scores.shape)}"
        raise InputError(f"{path}: expected scores {list(predictions.shape)} of numbers, got {got}")
    values = [[None] * predictions.shape[1]] * num_queries if scores is None else scores.tolist()
    for query, (rows, row_scores) in enumerate(zip(predictions.tolist(), values, strict=True)):
        yield from ((query, row, score) for row, score in zip(rows, row_scores, strict=True) if row >= 0)


def _read_pairs(path: Path, query_names: Sequence[str], database_names: Sequence[str]) -> list[Pair]:
    """Read the pairs of a file, in its order.

    Names may contain spaces or commas: of all splits of a line, the one with known names counts. (hloc splits at every
    space.) Lines that begin with # and hold no known pair are comments.

    Raises:
        InputError: a line has no split with known names, or several, or it has more than 10,000 characters or 200
            words.
    """
    with reading(path, mend="expected a text file of image pairs"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    sides = [{printable(name) for name in names} for names in (query_names, database_names)]
    ends = [{end for name in names for end in _ends(name)} for names in sides]
    pairs = []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = printable(line.strip())
        if stripped and (pair := _pair(f"{path}: line {number}", stripped, sides, ends)):
            pairs.append(pair)
    return pairs


def _read_predictions(folder: Path) -> list[Pair]:
    """Read the pairs of a folder of predictions. Positives are not read: the data set has its own ground truth."""
    pairs, files = [], dict[str, Path]()
    for path in sorted(folder.glob("*.txt")):
        query, predictions = read_predictions(path)
        if (other := files.setdefault(query, path)) != path:
            raise InputError(f"{path}: expected another query than in {other.name}, got {shorten(query)} again; "
                             "remove the files of older runs")  # fmt: skip
        results = path.with_suffix(".torch")
        if results.exists():
            pairs += _by_inliers(query, predictions, results)
        else:
            pairs += [Pair(query, database) for database in predictions]
    if not files:
        mend = "; copy the .torch files beside those of preds" if any(folder.glob("*.torch")) else ""
        raise InputError(f"{folder}: expected text files of predictions, one for each query, got none{mend}")
    return pairs


def _by_inliers(query: str, predictions: Sequence[str], results: Path) -> list[Pair]:
    """Pairs of the predictions that were matched, most inliers first; equal numbers keep their order."""
    counts = read_num_inliers(results)
    if not 0 < len(counts) <= len(predictions):
        raise InputError(f"{results}: expected results of at most {len(predictions)} predictions, as in the text file, "
                         f"got {len(counts)}; match the predictions of this run")  # fmt: skip
    order = sorted(range(len(counts)), key=lambda position: -counts[position])
    return [Pair(query, predictions[position], counts[position]) for position in order]


def _write_predictions(folder: Path, query_names: Sequence[str], lists: Sequence[Sequence[Sequence[str]]]) -> None:
    """Write a file for each query that has predictions; its number is the query's row.

    `lists` are the names of the predictions of each query, and those of its positives if they are known.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new or an empty folder, got another; choose a new path")
    folder.mkdir(parents=True, exist_ok=True)
    for row, (query, *names) in enumerate(zip(query_names, *lists, strict=True)):
        if names[0]:
            parts = [(QUERY, query), *((heading, *part) for heading, part in zip(_HEADINGS, names, strict=False))]
            text = "".join("\n".join(part) + "\n\n" for part in parts)  # To-Match needs the last empty line
            write_text(folder / f"{row:03d}.txt", text)


def _ends(name: str) -> tuple[str, str]:
    """File name and stem, which may stand for an image."""
    return PurePosixPath(name).name, PurePosixPath(name).stem


def _pair(where: str, line: str, sides: Sequence[Set[str]], ends: Sequence[Set[str]]) -> Pair | None:
    """The pair of a line; `sides` are the paths of query and database images, `ends` the ends of these paths."""
    words = line.split()
    if len(words) == 2 and words[0] in sides[0] and words[1] in sides[1]:
        return Pair(words[0], words[1])  # nearly every line of hloc
    if len(line) > _MOST_CHARACTERS or line.count(",") + len(words) > _MOST_WORDS:
        if line.startswith("#"):
            return None
        raise InputError(f"{where}: expected the names of a query and a database image, got {len(line)} characters")
    splits = list(_splits(line))
    pairs = [pair for pair in splits if pair.query in sides[0] and pair.database in sides[1]]
    pairs = pairs or [pair for pair in splits if _ends(pair.query)[0] in ends[0] and _ends(pair.database)[0] in ends[1]]
    if len(pairs) == 1:
        return pairs[0]
    if not pairs and line.startswith("#"):
        return None
    got = "several ways to read" if pairs else "names of none in"
    raise InputError(f"{where}: expected the names of a query and a database image, got {got} {shorten(line)!r}")


def _splits(line: str) -> Iterator[Pair]:
    """All pairs that a line may mean."""
    for separator in _SEPARATOR.finditer(line):
        query, database = line[: separator.start()], line[separator.end() :]
        yield Pair(query, database)
        name, comma, number = database.rpartition(",")
        if comma:
            with suppress(ValueError):  # no number
                yield Pair(query, name.rstrip(), parse_number(number.strip()))


def _rows(path: Path, names: Sequence[str], foreign: dict[str, None], side: str) -> dict[str, int]:
    """Row of each foreign name; raises an InputError for unknown names."""
    rows = {name: row for row, name in enumerate(match_names(path, names, foreign)) if name is not None}
    for name in foreign:
        if name not in rows:
            raise InputError(f"{path}: expected the relative path of a {side} image, got {shorten(name)!r}, which "
                             f"none of the {len(names)} has, or one has by its full path; give names with their "
                             "folders as the file has them")  # fmt: skip
    return rows


def _entries(path: Path, names: Sequence[str], rows: dict[str, int]) -> list[FileEntry | None]:
    entries = {row: FileEntry(path, match) for match, row in rows.items() if adds_folders(names[row], match)}
    return [entries.get(row) for row in range(len(names))]


def _shortlist(path: Path, candidates: list[Candidates], names: Sequence[str], num_candidates: int | None) -> Shortlist:
    depth = num_candidates or max(map(len, candidates))
    indices = np.full((len(candidates), depth), -1, np.int32)
    scores = np.zeros((len(candidates), depth), np.float32)
    has_score = {score is not None for rows in candidates for score in rows.values()}
    if len(has_score) == 2:
        raise InputError(f"{path}: expected scores of all pairs or of none, got some without")
    for query, rows in enumerate(candidates):
        count = min(len(rows), depth)
        indices[query, :count] = list(rows)[:count]
        if has_score == {True}:
            values = _descending(f"{path}: {shorten(names[query])}", list(rows.values()))
            scores[query, :count] = values[:count]
        else:
            scores[query, :count] = np.arange(depth, depth - count, -1)
    return Shortlist(indices=indices, scores=scores, mask=indices >= 0)


def _descending(where: str, scores: Any) -> np.ndarray:
    """Scores as float32; raises an InputError unless they are finite and descend, as distances do not."""
    with np.errstate(over="ignore"):
        values = np.array(scores, np.float32)
    if not np.isfinite(values).all():
        raise InputError(f"{where}: expected finite scores, got others")
    if (np.diff(values) > 0).any():
        raise InputError(f"{where}: expected scores, larger = better, that descend, got ascending ones; sort the "
                         "candidates, and negate distances")  # fmt: skip
    return values
