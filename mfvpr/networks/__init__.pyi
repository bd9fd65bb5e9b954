__all__ = [
    "Aliked",
    "D2Net",
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
]

from .aliked import Aliked
from .d2net import D2Net
from .lightglue import LightGlue
from .mixvpr import MixVPR
from .netvlad import Gem, NetVlad, VggNetVlad
from .resnet import ResNet50
from .vgg import SsmVgg, Vgg16
from .vit import SelaVpr, VisionTransformer
