"""Score a data set by a grid of parameters. The same as `mfvpr sweep`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("sweep")
