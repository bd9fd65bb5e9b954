"""Times mfvpr beside others. `python -m experiments.benchmark --help`."""

from experiments.benchmark.benchmarks import main

if __name__ == "__main__":
    main()
