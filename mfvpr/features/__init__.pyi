__all__ = [
    "Aggregated",
    "Aggregation",
    "AlikedFeatures",
    "D2NetFeatures",
    "Description",
    "Dinov2Features",
    "Extractor",
    "FeatureSet",
    "FeatureSource",
    "Fitting",
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
]

from .aliked_features import AlikedFeatures
from .d2net_features import D2NetFeatures
from .dinov2 import Dinov2Features
from .extractor import Aggregated, Aggregation, Description, Extractor, Fitting, Scale, Source
from .feature_set import FeatureSet, FeatureSource, InMemory
from .global_descriptor import GlobalDescriptor, MixVprDescriptor
from .patch_netvlad import PatchNetVladFeatures
from .selavpr_features import SelaVprFeatures
from .sift import Sift
from .ssm_features import SsmCells, SsmWindows
from .vlad import Vlad, VladFitting
from .windows import WindowFitting
