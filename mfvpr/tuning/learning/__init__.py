"""Learning of match weights and parameters of scorers from losses of a ranking, and its evaluation."""
