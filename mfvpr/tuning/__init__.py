"""Search and learning of the parameters of re-ranking.

Read first: sweeps (grids and Optuna, over whole data sets in compiled calls), learning/ (losses, training, match
weights).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
