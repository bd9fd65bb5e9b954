"""Learn match weights and parameters, and compare them with searched ones. The same as `mfvpr learn`."""

from mfvpr.cli.programs import run

if __name__ == "__main__":
    run("learn")
