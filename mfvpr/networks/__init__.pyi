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
from .gem import Gem
from .lightglue import LightGlue
from .mixvpr import MixVPR
from .netvlad import NetVlad, VggNetVlad
from .resnet import ResNet50
from .selavpr import SelaVpr
from .ssm import SsmVgg
from .vgg import Vgg16
from .vit import VisionTransformer
