__all__ = [
    "Images",
    "ImportedFeatures",
    "ImportedMatches",
    "open_features",
    "open_matches",
    "read_global_descriptors",
    "read_poses",
    "read_shortlist",
    "read_stamps",
    "stamps_in_names",
    "write_features",
    "write_global_descriptors",
    "write_shortlist",
    "write_trajectory",
]

from .features import (
    ImportedFeatures,
    open_features,
    read_global_descriptors,
    write_features,
    write_global_descriptors,
)
from .matches import Images, ImportedMatches, open_matches
from .shortlists import read_shortlist, write_shortlist
from .trajectories import read_poses, read_stamps, stamps_in_names, write_trajectory
