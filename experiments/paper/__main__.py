"""The paper's evaluation. `python -m experiments.paper --help`."""

from mfvpr.cli.launch import launch

if __name__ == "__main__":
    launch("paper")
