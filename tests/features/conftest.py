"""Settings that the tests of programs with features share."""

import pytest


@pytest.fixture
def street_settings(small_street):
    """Settings of a data set for the command line."""
    folders = f"dataset.database={small_street}/database", f"dataset.queries={small_street}/queries"
    return ("dataset=folder", *folders, "dataset.ground_truth=order")
