"""Learn scores, and compare them with hand-set and grid-searched ones on other queries."""

from experiments.launch import launch, program

learn = program("learning", "learn")

if __name__ == "__main__":
    launch(learn, "learn")
