"""Draw the pictures of `experiments/results.md` from its tables: `python -m notebooks.draw_results`."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from notebooks.build import CORRECT, INCORRECT, small

PAGE = Path(__file__).parent.parent / "experiments" / "results.md"
COLORS = {"SIFT": CORRECT, "ALIKED": INCORRECT}
LEGEND = {"SIFT": "SIFT", "ALIKED": "ALIKED n32 (system=mfvpr: n16)"}


def read_table(page: str, *header: str) -> list[list[str]]:
    """The rows of the only table whose header begins with these cells."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines()]
    [start] = [number for number, cells in enumerate(rows) if tuple(cells[: len(header)]) == header]
    length = next(number for number, cells in enumerate(rows[start:]) if len(cells) == 1)
    return rows[start + 2 : start + length]


def real_recall(page: str) -> dict[str, dict[str, list[float]]]:
    """System -> features -> R@1 within 2 frames on GRIEF and in the corridor."""
    recall: dict[str, dict[str, list[float]]] = {}
    for row in read_table(page, "system", "GRIEF ±1"):
        [features] = [name for name in COLORS if name in row[0]]
        system = "retrieval (VLAD)" if row[0].startswith("VLAD") else row[0].split("-", 1)[-1].split(", ")[-1]
        recall.setdefault(system, {})[features] = [float(row[2]), float(row[5])]
    return recall


def query_times(page: str) -> dict[str, list[list[float]]]:
    """Curve -> pairs of the number of database images and the milliseconds of a query."""
    table, maps = read_table(page, "images", "dimensions"), read_table(page, "features", "images")
    cells = {"evaluation, features on disk": [(row[0], row[2]) for row in table if row[1] == "128"]}
    for column, place in ((2, "memory"), (4, "disk")):
        for row in maps:
            cells.setdefault(f"map, {row[0]}, candidates from {place}", []).append((row[1], row[column]))
    return {name: [[float(cell.replace(",", "")) for cell in pair] for pair in pairs] for name, pairs in cells.items()}


def candidate_times(page: str) -> dict[str, list[list[float]]]:
    """Curve -> pairs of the number of candidates and the milliseconds of a query."""
    rows = [[float(cell) for cell in row] for row in read_table(page, "candidates", "ALIKED: matching, ms")]
    names = ("ALIKED, matching", "ALIKED, scores", "SIFT, matching", "SIFT, scores")
    return {name: [[row[0], row[place]] for row in rows] for place, name in enumerate(names, start=1)}


def draw(page: str, folder: Path) -> None:
    """Write all pictures into a folder."""
    recall = real_recall(page)
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 5), layout="constrained", sharey=True)
    for place, (panel, title) in enumerate(zip(panels, ("GRIEF", "corridor"), strict=True)):
        for offset, (features, color) in zip((-0.2, 0.2), COLORS.items(), strict=True):
            values = [recall[system][features][place] for system in recall]
            bars = panel.barh(np.arange(len(recall)) + offset, values, 0.4, color=color, label=LEGEND[features])
            panel.bar_label(bars, fmt="%.1f", padding=2, fontsize=8)
        panel.set(title=title, xlabel="R@1 within 2 frames, %", xlim=(0, 100))
        panel.set_yticks(range(len(recall)), recall)
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _save(figure, folder / "recall.png")
    draw_times(query_times(page), "images in the database", folder / "database_size.png")
    draw_times(candidate_times(page), "candidates of a query", folder / "candidates.png")


def draw_times(curves: dict[str, list[list[float]]], size: str, path: Path) -> None:
    """Draw the time of a query against a size, a curve for each name."""
    figure, panel = plt.subplots(figsize=(8, 3.2), layout="constrained")
    for name, points in curves.items():
        color = next((color for features, color in COLORS.items() if features in name), "#888888")
        dashed = "disk" in name or "scores" in name
        panel.plot(*zip(*points, strict=True), "o--" if dashed else "o-", color=color, label=name)
    panel.set(xlabel=size, ylabel="time of a query, ms", ylim=(0, None))
    figure.legend(loc="outside right center", fontsize=9)
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    figure.canvas.draw()
    path.write_bytes(small(Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))))
    plt.close(figure)


if __name__ == "__main__":
    (PAGE.parent / "pictures").mkdir(exist_ok=True)
    draw(PAGE.read_text(), PAGE.parent / "pictures")
