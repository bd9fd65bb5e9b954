"""The data set that the tests of evaluations share."""

import pytest

from mfvpr.datasets import folder_dataset


@pytest.fixture(scope="session")
def dataset(small_street):
    """The synthetic street's ten queries, each with its database image."""
    return folder_dataset(small_street / "database", small_street / "queries", ground_truth="order")
