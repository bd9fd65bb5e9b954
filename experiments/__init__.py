"""What belongs to a clone: the programs of `mfvpr.cli` by name, the benchmark, the paper's evaluation, results."""
