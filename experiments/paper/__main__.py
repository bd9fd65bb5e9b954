"""The paper's evaluation. `python -m experiments.paper --help`."""

from experiments.launch import launch
from experiments.paper import paper

if __name__ == "__main__":
    launch(paper, "paper")
