"""What can be learned from losses of a ranking: match weights, projections, scorers' numbers; and what it is worth."""
