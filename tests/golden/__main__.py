"""Write a golden file: `python -m tests.golden NAME ARGUMENTS` with the arguments of `make_NAME.py`."""

import sys
from importlib import import_module

import numpy as np

maker = import_module(f"tests.golden.make_{sys.argv[1]}")
np.savez_compressed(maker.GOLDEN, **maker.main(*sys.argv[2:]))
