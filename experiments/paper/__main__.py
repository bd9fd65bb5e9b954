"""The paper's evaluation. `python -m experiments.paper --help`."""

from experiments.launch import launch

if __name__ == "__main__":
    launch("paper")
