__all__ = [
    "AllowedTruth",
    "Dataset",
    "FrameTruth",
    "ImageFolder",
    "LabelTruth",
    "Positives",
    "QuerySequence",
    "RadiusTruth",
    "Truth",
    "folder_dataset",
    "frame_positives",
    "image_folder",
    "radius_positives",
    "read_image",
    "resize",
    "sequences_dataset",
]

from .datasets import Dataset, ImageFolder, QuerySequence, folder_dataset, image_folder, sequences_dataset
from .ground_truth import AllowedTruth, FrameTruth, LabelTruth, RadiusTruth
from .images import read_image, resize
from .positives import Positives, frame_positives, radius_positives
from .truth import Truth
