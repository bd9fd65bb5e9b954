__all__ = [
    "AllowedTruth",
    "Dataset",
    "FrameTruth",
    "ImageFolder",
    "IndexFile",
    "LabelFiles",
    "LabelTruth",
    "Positives",
    "QuerySequence",
    "RadiusTruth",
    "Truth",
    "folder",
    "frame_positives",
    "image_folder",
    "radius_positives",
    "read_image",
    "resize",
]

from .datasets import Dataset, ImageFolder, IndexFile, LabelFiles, QuerySequence, folder, image_folder
from .ground_truth import AllowedTruth, FrameTruth, LabelTruth, RadiusTruth, Truth
from .image_reading import read_image, resize
from .positives import Positives, frame_positives, radius_positives
