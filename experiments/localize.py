"""Localize images in a map. The same as `mfvpr localize`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("localize")
