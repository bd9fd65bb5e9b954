"""Versions of the software that computes results."""

import platform
from functools import cache
from importlib.metadata import version

from mfvpr import __version__

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "opencv-python-headless", "pillow")


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of mfvpr and of the packages, by name."""
    return {
        "mfvpr": __version__,
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
    }
