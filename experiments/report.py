"""Pages of run folders: of one run, or of several compared. The same as `mfvpr report`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("report")
