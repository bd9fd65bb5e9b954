"""Makes ssm.npz: what SSM-VPR's program computes on made-up maps and images. `python -m tests.golden ssm CLONE`

CLONE is a clone of https://github.com/Chicone/SSM-VPR, whose program is run without its windows (torch, scikit-learn,
scikit-image, on the CPU): its database, its candidates, its spatial matching, its scores.
"""

import csv
import os
import sys
import tempfile
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
from PIL import Image

from tests.golden.torch_networks import replace_module
from tests.random_checkpoints import layered, places365_shapes, random_checkpoint

DATABASE, QUERIES, CANDIDATES = 5, 4, 4
MAPS = {"maps0": 0, "maps1": 1, "maps2": 2}  # seeds, by case
IMAGES = {"images224": (1, 224, 5, 4), "images336": (0, 336, 2, 1)}  # seed, px of the second stage, database, queries
SIDES, CHANNELS = (14, 12), 16  # of made-up maps, of both stages
DIMENSIONS = (12, 10)
FILE = "image{:04d}.png"


def made_up_map(seed: int, stage: int, row: int, query: bool) -> np.ndarray:
    """`[side, side, CHANNELS]` float32: few patterns of falling strength; queries show database images, moved."""
    side = SIDES[stage - 1]
    basis = np.random.default_rng([seed, stage]).normal(size=(CHANNELS + 1, CHANNELS))
    shown = np.random.default_rng([seed, stage, row]).normal(size=(side, side, CHANNELS))
    if query:
        noise = np.random.default_rng([seed, stage, row, 1]).normal(size=shown.shape)
        shown = 0.8 * np.roll(shown, (1, 1 - row), axis=(0, 1)) + 0.6 * noise
    return ((shown * 0.85 ** np.arange(CHANNELS)) @ basis[1:] + basis[0]).astype(np.float32)


def picture(row: int, query: bool) -> np.ndarray:
    """`[72, 96, 3]` uint8 by integer arithmetic; queries show database images, brighter and moved by 6 px."""
    y, x, channel = np.indices((72, 96, 3))
    if query:
        x = x + 6
    circles = (y - 20 - 9 * row) ** 2 + (x - 70 + 11 * row) ** 2
    stripes = 37 * ((y // (5 + row) + x // (9 - row)) % 4) + (x * y * (row + 2)) // (90 + 30 * channel)
    return ((stripes + 80 * (circles < 300) + 20 * query) % 256).astype(np.uint8)


def main(clone: str) -> dict[str, np.ndarray]:
    golden: dict[str, np.ndarray] = {}
    program = _program(clone)
    cases = {case: (seed, None, DATABASE, QUERIES) for case, seed in MAPS.items()} | IMAGES
    for case, settings in cases.items():
        golden |= {f"{case}/{name}": array for name, array in _run(program, *settings).items()}
        if case in IMAGES:
            del golden[f"{case}/cells"]  # hundreds of kB
    return golden


def _run(program: type, seed: int, pixels: int | None, num_database: int, num_queries: int) -> dict[str, np.ndarray]:
    """The database, and what is recognized; in a folder of its own, as the program writes where it is."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        try:
            for folder in ("db", "pca", "data/Reference", "data/Live"):
                Path(folder).mkdir(parents=True)
            for folder, number in (("Reference", num_database), ("Live", num_queries)):
                for row in range(number):
                    Image.fromarray(picture(row, folder == "Live")).save(f"data/{folder}/{FILE.format(row)}")
            with open("truth.csv", "w", newline="") as file:
                csv.writer(file).writerows([("Reference", "Live"), *((row, row) for row in range(num_queries))])
            run = program(seed, pixels, min(CANDIDATES, num_database))
            run.create_db()
            run.recognise_places()
            size = pixels or 336
            stage1, stage2 = (np.load(f"db/data_stage{n}_{s}_VGG16.npy") for n, s in ((1, 224), (2, size)))
        finally:
            os.chdir(before)
    index = np.array(run.index)
    votes = np.array(run.votes)
    return {
        "windows": stage1,
        "cells": stage2,
        "candidates": np.array(run.candidates).astype(np.int8),
        "votes": votes.astype(np.int16),
        "index": index.astype(np.int16),
        "scores": np.array(run.scores),
        "zero_scores": np.array([[_padded_by_zeros(query_index) for query_index in of_query] for of_query in index]),
        "weights": np.array(run.weights),
    }


def _padded_by_zeros(index: np.ndarray) -> int:
    """The score of the program's GPU path, which needs one: as on the CPU, with 0 beyond the grid."""
    import torch

    side = len(index)
    size = int(0.75 * side)
    size -= size % 2 == 0
    half = size // 2
    beyond = torch.nn.functional.pad(torch.from_numpy(index)[None], (half,) * 4)[0]
    patches = beyond.unfold(0, size, 1).unfold(1, size, 1).reshape(side**2, size, size)
    offsets = torch.arange(-half, half + 1)
    expected = torch.from_numpy(index).reshape(-1, 1, 1) + side * offsets[:, None] + offsets
    return int((patches == expected).sum())


def _program(clone: str) -> Any:
    """The program's class without windows; what it computes on the way gathers in lists."""
    _without_windows()
    sys.path.insert(0, clone)
    import ssm
    import torch
    from torchvision import transforms
    from vgg16_model import VGG16Model

    class Program(ssm.ssm_MainWindow):
        def __init__(self, seed: int, pixels: int | None, num_candidates: int) -> None:
            self.seed, self.pixels = seed, pixels
            self.method1 = self.method2 = "VGG16"
            self.reference_folder, self.test_folder, self.ground_truth_file = "data/Reference", "data/Live", "truth.csv"
            self.ref_dir, self.batch_size = "data/Reference/", 250
            self.lblk, self.sblk, self.max_ncubes, self.npf, self.ftol = 4, 1, 36, 2, 0
            (self.num_dim1, self.num_dim2), self.ns1, self.ns2 = DIMENSIONS, 10000, 10000
            self.recognition_paused = self.recognition_stopped = self.recognition_continued = False
            size = pixels or 336
            self.image_size1, self.image_size2 = (224, 224), (size, size)
            self.imageWidthLineEdit_s1, self.imageWidthLineEdit_s2, self.candidatesLineEdit = (
                SimpleNamespace(text=lambda text=text: text) for text in ("224", str(size), str(num_candidates))
            )
            to_pixels = [transforms.ToTensor(), transforms.Normalize((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))]
            self.preprocess1, self.preprocess2 = (  # as by the program's button that makes the database
                transforms.Compose([transforms.Resize(side), *to_pixels])
                for side in (self.image_size1, self.image_size2)
            )
            self.model_stage1 = self.model_stage2 = self.retrieve_model("VGG16")
            self.candidates, self.votes, self.index, self.scores, self.weights = [], [], [], [], []

        def __getattr__(self, name: str) -> Any:
            if name in ("vectors_local", "image_numbers_local", "pca", "pca_geom"):
                raise AttributeError(name)
            return MagicMock()

        def retrieve_model(self, method: str) -> Any:
            if self.pixels is None:
                return None
            model = VGG16Model.__new__(VGG16Model)
            torch.nn.Module.__init__(model)
            model.weights_dict = layered(random_checkpoint(places365_shapes(full=False), self.seed))
            for layer, parts in model.weights_dict.items():
                outputs, inputs = parts["weights"].shape[:2]
                conv = model._VGG16Model__conv(
                    2, layer, in_channels=inputs, out_channels=outputs, kernel_size=(3, 3), stride=(1, 1), bias=True
                )
                setattr(model, layer, conv)
            return model.eval()

        def get_pytorch_tensors(self, fpath: str) -> Any:
            if self.pixels is not None:
                return super().get_pytorch_tensors(fpath)
            query, row = "Live" in fpath, self.get_img_no(os.path.basename(fpath))
            first, second = (made_up_map(self.seed, stage, row, query) for stage in (1, 2))
            return first[None], second[None]

        def get_candidates_vgg16(self, *arguments: Any) -> Any:
            candidates, counts, votes = super().get_candidates_vgg16(*arguments)
            self.candidates.append(candidates)
            self.votes.append(votes)
            return candidates, counts, votes

        def compute_neighbors(self, *arguments: Any) -> Any:
            self.index.append(super().compute_neighbors(*arguments))
            self.scores.append([])
            self.weights.append([])
            return self.index[-1]

        def get_score_patch(self, *arguments: Any) -> Any:
            score = super().get_score_patch(*arguments)
            if self.scores:  # not of the image with itself, which comes first
                self.scores[-1].append(score)
            return score

        def use_frame_corr(self, *arguments: Any) -> Any:
            self.weights[-1].append(super().use_frame_corr(*arguments))
            return self.weights[-1][-1]

        def PrintEvaluation(self, *arguments: Any, **named: Any) -> None:
            pass

        image_visualize_query = image_visualize_reference = image_visualize_output = PrintEvaluation
        refresh_view = reset_controls = PrintEvaluation

    return Program


def _without_windows() -> None:
    """Modules of windows and figures are nothing; torchvision's transforms are Pillow's, as the real ones."""
    import torch

    class Window:
        pass

    names = ("QtCore", "QtGui", "QtWidgets", "QApplication", "QMessageBox", "QThreadPool")
    qt = {name: MagicMock() for name in names} | {"QRunnable": Window}
    for name in ("PyQt5", "PyQt5.QtWidgets", "PyQt5.QtCore", "PyQt5.QtGui", "PyQt5.QtWebEngineWidgets"):
        replace_module(name, **qt, QMainWindow=Window)
    replace_module("tkinter", filedialog=MagicMock(), Tk=MagicMock(), messagebox=MagicMock())
    replace_module("matplotlib", pyplot=MagicMock())
    replace_module("about", Ui_AboutBox=Window)
    replace_module("netvlad_model")

    steps = {
        "Resize": lambda size: lambda image: image.resize(size, Image.Resampling.BILINEAR),
        "CenterCrop": lambda size: lambda image: image,
        "ToTensor": lambda: lambda image: torch.from_numpy(np.array(image)).permute(2, 0, 1).float().div(255),
        "Normalize": lambda mean, std: lambda tensor: (tensor - _column(mean)) / _column(std),
    }

    def compose(parts: list[Any]) -> Any:
        return lambda image: reduce(lambda transformed, part: part(transformed), parts, image)

    def _column(values: list[float]) -> torch.Tensor:
        return torch.tensor(values)[:, None, None]

    transforms = replace_module("torchvision.transforms", Compose=compose, **steps)
    replace_module("torchvision", transforms=transforms, models=replace_module("torchvision.models"))
