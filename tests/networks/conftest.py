"""Numbers of the public codes."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def golden(request):
    """The arrays of `tests/golden/NAME.npz` for the tests of `test_NAME.py` and `test_NAME_golden.py`."""
    name = request.path.stem.removeprefix("test_").removesuffix("_golden")
    return dict(np.load(request.config.rootpath / "tests" / "golden" / f"{name}.npz"))
