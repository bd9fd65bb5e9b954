"""Times mfvpr against the peers of the field: `python -m experiments.benchmark --help`."""
