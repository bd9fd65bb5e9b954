"""The paper's evaluation. `python -m experiments.paper --help`."""

from mfvpr.cli.programs import launch

if __name__ == "__main__":
    launch("paper", "experiments.paper.program:paper")
