__all__ = [
    "Aliked",
    "D2Net",
    "EfficientNetLite0",
    "Gem",
    "LightGlue",
    "MixVPR",
    "NetVlad",
    "ResNet50",
    "SelaVpr",
    "SsmVgg",
    "Vgg16",
    "VggNetVlad",
    "VisionTransformer",
    "XFeat",
]

from .aliked import Aliked
from .backbones import ResNet50, SsmVgg, Vgg16
from .d2net import D2Net
from .efficientnet import EfficientNetLite0
from .global_descriptors import Gem, MixVPR, NetVlad, VggNetVlad
from .lightglue import LightGlue
from .vit import SelaVpr, VisionTransformer
from .xfeat import XFeat
