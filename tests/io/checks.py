"""Expectations of many tests: errors of one line."""

from contextlib import contextmanager

import pytest

from mfvpr import InputError


@contextmanager
def one_line_error(message=None, *words):
    """Expects an error of one line that matches `message` and contains `words`."""
    with pytest.raises(InputError, match=message) as error:
        yield
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400
    assert all(word in str(error.value) for word in words)
