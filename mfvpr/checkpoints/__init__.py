"""Published weights: where they are, how their checkpoints become runtime files, and networks filled with them."""
