"""Evaluation of all stages in one call: recall, precision, calibration, statistics.

Read first: dataset_ranking (`rank_dataset`: all stages), stages (its steps), protocol (choose settings on one half,
report on the other), confidence, statistics.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
