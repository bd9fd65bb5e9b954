"""Published weights: list them, download, convert, verify. The same as `mfvpr weights`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("weights")
