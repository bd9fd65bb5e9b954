"""The systems that are compared on a small data set."""

import mfvpr
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval

SIFT = Sift(max_keypoints=60, image_size=(160, 120))
VLAD = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}
