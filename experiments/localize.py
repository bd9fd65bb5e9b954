"""Localize images in a map: a line of JSON for each. `python -m experiments.localize --help`."""

from experiments.launch import launch

if __name__ == "__main__":
    launch("localize")
