"""Run the notebooks, keep their output, and draw the pictures of the README: `python notebooks/build.py`.

A notebook keeps a hash of the code that its output is of.
"""

import base64
import hashlib
import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import nbformat
import numpy as np
from nbclient import NotebookClient
from PIL import Image

from mfvpr.datasets.image_reading import open_image

FOLDER = Path(__file__).parent
PICTURES = FOLDER / "pictures"
RUN_OF = "code_sha256"  # the notebook's metadata
CORRECT, INCORRECT = "#2fa8ff", "#ff9a1f"  # told apart by color-blind people as well


def run_notebook(path: Path) -> None:
    """Execute a notebook in an empty folder, and keep its output with small pictures."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                output.metadata = {}
                image = open_image(io.BytesIO(base64.b64decode(output.data["image/png"])))
                output.data["image/png"] = base64.b64encode(small(image)).decode()
                output.data["text/plain"] = "<Figure>"
    notebook.metadata = {"kernelspec": notebook.metadata.kernelspec, RUN_OF: code_hash(notebook)}
    nbformat.write(notebook, path)


def code_hash(notebook: nbformat.NotebookNode) -> str:
    """The hash of all code of a notebook."""
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def small(image: Image.Image) -> bytes:
    """A PNG of 64 colors, at most 960 px wide: below 100 kB."""
    image = image.convert("RGB")
    if image.width > 960:
        image = image.resize((960, round(960 * image.height / image.width)), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    image.quantize(64).save(content, "png", optimize=True)
    return content.getvalue()


def draw_reranking() -> None:
    """The query of the first notebook, its candidates before and after re-ranking, and the histogram of shifts."""
    notebook, names = nbformat.read(FOLDER / "1_rerank_one_query.ipynb", as_version=4), dict[str, Any]()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            exec(cell.source, names)
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
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))
    (PICTURES / "reranking.png").write_bytes(small(picture))


def show(panel: plt.Axes, image: np.ndarray, title: str, color: str = "black") -> None:
    """An image with a title and a frame."""
    panel.imshow(image)
    panel.set_title(title, fontsize=10)
    panel.set(xticks=[], yticks=[])
    plt.setp(panel.spines.values(), color=color, linewidth=1 if color == "black" else 4)


def draw_run() -> None:
    """A figure of `mfvpr evaluate`, and its report page if there is a browser."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["scorer=demo", "figures=[14]", f"out={folder}/run"]
        subprocess.run(
            [sys.executable, "-c", "from mfvpr.cli.programs import main; main()", "evaluate", *settings], check=True
        )
        [figure] = Path(folder, "run", "figures").glob("*correct*.png")
        (PICTURES / "run.png").write_bytes(small(open_image(figure)))
        if browser := shutil.which("chromium"):
            page, shot = f"file://{folder}/run/report.html", f"{folder}/page.png"
            options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1200,1120"]
            subprocess.run([browser, *options, f"--screenshot={shot}", page], check=True, capture_output=True)
            (PICTURES / "report.png").write_bytes(small(open_image(shot)))


if __name__ == "__main__":
    for path in sorted(FOLDER.glob("*.ipynb")):
        run_notebook(path)
    draw_reranking()
    draw_run()
