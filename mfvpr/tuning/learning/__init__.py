"""Learning of match weights, projections and parameters of scorers from losses of a ranking, and its evaluation."""
