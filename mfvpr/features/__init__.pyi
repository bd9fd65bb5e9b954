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

from .aliked import AlikedFeatures
from .d2net import D2NetFeatures
from .dinov2 import Dinov2Features
from .extractor import Aggregated, Aggregation, Description, Extractor, Fitting, Scale, Source
from .feature_set import FeatureSet, FeatureSource, InMemory
from .global_descriptor import GlobalDescriptor, MixVprDescriptor
from .patch_netvlad import PatchNetVladFeatures
from .selavpr import SelaVprFeatures
from .sift import Sift
from .ssm import SsmCells, SsmWindows
from .vlad import Vlad, VladFitting
from .windows import WindowFitting
