"""What can be learned, from losses of a ranking: match weights, projections, scorers' numbers; the loop that fits."""
