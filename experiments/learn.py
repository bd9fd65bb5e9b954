"""Learn scores, and compare them with hand-set and grid-searched ones on other queries."""

from experiments.launch import launch

if __name__ == "__main__":
    launch("learn")
