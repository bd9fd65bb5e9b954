__all__ = [
    "Aggregated",
    "AlikedFeatures",
    "D2NetFeatures",
    "Description",
    "Dinov2Features",
    "EfficientNetDescriptor",
    "Extractor",
    "FeatureSet",
    "FeatureSource",
    "GlobalDescriptor",
    "InMemory",
    "MixVprDescriptor",
    "PatchNetVladFeatures",
    "Scale",
    "SelaVprFeatures",
    "Sift",
    "Source",
    "SsmCells",
    "SsmWindows",
    "Vlad",
    "VladFitting",
    "WindowFitting",
    "XFeatFeatures",
]

from .extractor import Aggregated, Description, Extractor, Scale, Source
from .feature_set import FeatureSet, FeatureSource, InMemory
from .network import (
    AlikedFeatures,
    D2NetFeatures,
    EfficientNetDescriptor,
    GlobalDescriptor,
    MixVprDescriptor,
    XFeatFeatures,
)
from .patch_networks import Dinov2Features, PatchNetVladFeatures, SelaVprFeatures
from .sift import Sift
from .ssm_features import SsmCells, SsmWindows
from .vlad import Vlad, VladFitting
from .whitening import WindowFitting
