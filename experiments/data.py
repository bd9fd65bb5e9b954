"""Data sets by name: list them, and check what a folder holds. The same as `mfvpr data`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("data")
