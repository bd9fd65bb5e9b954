"""Features, global descriptors and shortlists of other programs: read, checked and written.

Read first: features and descriptors (what is read), names (which entry belongs to which image), then the formats:
npz, h5, pairs, and formats/ (MATLAB files, pickles and NumPy objects, read as data).

Imports types, utils.
"""

from mfvpr.io.descriptors import read_global_descriptors, write_global_descriptors
from mfvpr.io.feature_files import write_features
from mfvpr.io.features import ImportedFeatures, open_features
from mfvpr.io.shortlists import read_shortlist, reranked, write_shortlist

__all__ = [
    "ImportedFeatures",
    "open_features",
    "read_global_descriptors",
    "read_shortlist",
    "reranked",
    "write_features",
    "write_global_descriptors",
    "write_shortlist",
]
