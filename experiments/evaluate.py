"""Evaluate systems: two folders of images in, a table of recall, rankings and figures out."""

from experiments.launch import launch, program

evaluate = program("evaluation", "evaluate")

if __name__ == "__main__":
    launch(evaluate)
