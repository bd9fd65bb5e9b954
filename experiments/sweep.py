"""Sweep parameters: the recall of every setting of a grid, the best setting, and its confidence interval."""

from experiments.launch import launch

if __name__ == "__main__":
    launch("sweep")
