"""Evaluate systems: two folders of images in, a table of recall, rankings and figures out."""

from experiments.launch import launch

if __name__ == "__main__":
    launch("config")
