"""Draw the pictures of the README into notebooks/pictures: `python notebooks/draw_pictures.py`.

The first is made with the code of the first notebook, the second by `mfvpr evaluate`.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

FOLDER = Path(__file__).parent
PICTURES = FOLDER / "pictures"
CORRECT, INCORRECT = "#2fa8ff", "#ff9a1f"  # told apart by color-blind people as well


def draw_reranking() -> None:
    """The query of the first notebook, its candidates before and after re-ranking, and the histogram of shifts."""
    notebook = json.loads((FOLDER / "1_rerank_one_query.ipynb").read_text())
    names: dict = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    plt.close("all")
    figure = plt.figure(figsize=(12, 4.2), layout="constrained")
    grid = figure.add_gridspec(2, 7, width_ratios=(2.1, 1, 1, 1, 1, 0.1, 2.4))
    show(figure.add_subplot(grid[:, 0]), names["brightened"], "query at night")
    for row, (system, title) in enumerate([("retrieval", "retrieval"), ("histogram of shifts", "re-ranked")]):
        for column, place in enumerate(names["order"][system][:4]):
            color = CORRECT if names["correct"][place] else INCORRECT
            panel = figure.add_subplot(grid[row, 1 + column])
            show(panel, names["database_images"][names["rows"][place]], f"{title}, {column + 1}", color)
    scores, x, y = names["explanations"]["correct"].histogram
    panel = figure.add_subplot(grid[:, 6])
    panel.pcolormesh(x, y, scores, cmap="magma", rasterized=True)
    panel.plot(*names["explanations"]["correct"].peak, "o", color="cyan", markersize=16, fillstyle="none")
    panel.set(title="histogram of shifts of the first", xlabel="shift x, px", ylabel="shift y, px", aspect="equal")
    panel.invert_yaxis()
    figure.suptitle("blue: correct, orange: incorrect", fontsize=10)
    figure.canvas.draw()
    save(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())), "reranking.png")


def show(panel: plt.Axes, image: np.ndarray, title: str, color: str = "black") -> None:
    """An image with a title and a frame."""
    panel.imshow(image)
    panel.set_title(title, fontsize=10)
    panel.set(xticks=[], yticks=[])
    plt.setp(panel.spines.values(), color=color, linewidth=1 if color == "black" else 4)


def draw_run() -> None:
    """A figure of `mfvpr evaluate`."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["scorer=histogram", "figures=[14]", f"out={folder}/run"]
        subprocess.run(
            [sys.executable, "-c", "from mfvpr.cli.programs import main; main()", "evaluate", *settings], check=True
        )
        [figure] = Path(folder, "run", "figures").glob("*correct*.png")
        save(Image.open(figure), "run.png")


def save(image: Image.Image, name: str) -> None:
    """Write a picture with 128 colors, at most 1000 px wide."""
    image = image.convert("RGB")
    if image.width > 1000:
        image = image.resize((1000, round(1000 * image.height / image.width)), Image.Resampling.LANCZOS)
    image.quantize(128).save(PICTURES / name, optimize=True)


if __name__ == "__main__":
    draw_reranking()
    draw_run()
