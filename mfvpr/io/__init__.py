"""Read, check and write features, global descriptors and shortlists of other programs.

Read first: features and descriptors (the formats), names (matches entries of a file to images), then the readers:
npz, h5, pairs, and formats/ (MATLAB files, pickles and NumPy objects, read as data).

Imports types, utils.
"""

from mfvpr.io.descriptors import read_global_descriptors, write_global_descriptors
from mfvpr.io.feature_files import write_features
from mfvpr.io.features import ImportedFeatures, open_features
from mfvpr.io.shortlists import read_shortlist, reranked_shortlist, write_shortlist

__all__ = [
    "ImportedFeatures",
    "open_features",
    "read_global_descriptors",
    "read_shortlist",
    "reranked_shortlist",
    "write_features",
    "write_global_descriptors",
    "write_shortlist",
]
