"""Write a golden file: `python -m tests.golden NAME ARGUMENTS` with the arguments of `make_NAME.py`."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np

name, *arguments = sys.argv[1:]
sys.path[:0] = arguments  # clones of public code
arrays = import_module(f"tests.golden.make_{name}").main(*arguments)
np.savez_compressed(Path(__file__).parent / f"{name}.npz", **arrays)
