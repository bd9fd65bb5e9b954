"""Programs of a clone: those of `mfvpr.cli` by name, the benchmark, the paper's evaluation; and their results."""
