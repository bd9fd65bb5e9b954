"""Makes exported.npz: an exported scorer as ONNX model, and its check files. `python -m tests.golden exported`"""

import tempfile
from pathlib import Path

import numpy as np

import mfvpr
import mfvpr.deployment


def export_scorer(folder: Path, *, onnx: bool) -> mfvpr.deployment.ExportedProgram:
    shapes = mfvpr.ExportShapes(candidates=3, keypoints=30, image_size=(320, 240))
    return mfvpr.export(folder, mfvpr.HistogramOfShifts(), shapes, with_shift=True, onnx=onnx)


def main() -> dict[str, np.ndarray]:
    folder = Path(tempfile.mkdtemp()) / "exported"
    export_scorer(folder, onnx=True)
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix in (".onnx", ".npy")]
    return {path.relative_to(folder).as_posix(): np.frombuffer(path.read_bytes(), np.uint8) for path in files}
