"""Build a map for localization, add images to it, list its content. The same as `mfvpr map`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("map")
