"""Evaluate systems: two folders of images in, recall, rankings and figures out. The same as `mfvpr evaluate`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("evaluate")
