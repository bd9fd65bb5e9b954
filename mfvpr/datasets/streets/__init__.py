"""The synthetic street for demonstrations and tests: the same places by day, and again at night or in snow.

World axes: x to the right, y down, z along the street, in meters; the ground is y = 0. A pinhole camera drives
along z and sees flat panels (facades, roofs, trees, cars) in true perspective, painted from far to near. Colors are
RGB, 0..255.
"""

from mfvpr.datasets.streets.drawing import CONDITIONS, TRUTH, draw_streets, streets_folder

__all__ = ["CONDITIONS", "TRUTH", "draw_streets", "streets_folder"]
