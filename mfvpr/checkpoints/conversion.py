"""Convert the tensors of published checkpoints to the parameters of our networks, by one table of names per network.

The conversion is strict: each key is used once or listed as ignored, each parameter is set once, and all types and
shapes are checked.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError

# Axes of the source in our order.
UPSAMPLING = (2, 3, 0, 1)  # a transposed convolution's IOHW -> HWIO
LINEAR = (1, 0)  # (out, in) -> (in, out), also of 1 x 1 convolutions
_OF_KERNELS = {4: (2, 3, 1, 0), 2: LINEAR}  # by the number of our axes; OIHW -> HWIO
_PARAMETERS = {  # name in the checkpoint -> in our modules, the first one that the module has
    "weight": ("kernel", "scale"),
    "weights": ("kernel",),
    "bias": ("bias",),
    "running_mean": ("mean",),
    "running_var": ("var",),
    "0": ("kernel",),  # MATLAB's cells
    "1": ("bias",),
}


@dataclass(frozen=True)
class Table:
    """Names of a network's checkpoint, by regular expressions that match in full.

    Attributes:
        names: modules, or whole keys -> our dotted paths, with the groups of the expression.
        ignored: keys that the network does not need -> their shapes if these identify the checkpoint, or None.
        axes: our paths -> order of the source's axes; by default, kernels have PyTorch's layout.
        changes: our paths -> function of the tensor, before its axes are ordered.
    """

    names: Mapping[str, str]
    ignored: Mapping[str, tuple[int, ...] | None] = field(default_factory=dict)
    axes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    changes: Mapping[str, Callable[[np.ndarray], np.ndarray]] = field(default_factory=dict)

    def path_of(self, key: str, paths: Collection[str]) -> str:
        """The one of these paths that a key of the checkpoint sets; "" if there is none."""
        module, _, name = key.rpartition(".")
        forms = [(key, ""), *((module, f".{parameter}") for parameter in _PARAMETERS.get(name, ()))]
        for pattern, target in self.names.items():
            for form, ending in forms:
                if (match := re.fullmatch(pattern, form)) and (path := match.expand(target) + ending) in paths:
                    return path
        return ""

    def axes_of(self, path: str, num_axes: int) -> tuple[int, ...]:
        """Axes of the source in the order of the parameter's; () = they have the same order."""
        for pattern, axes in self.axes.items():
            if re.fullmatch(pattern, path):
                return axes
        return _OF_KERNELS[num_axes] if path.endswith(".kernel") else ()


def convert(
    source: Mapping[str, np.ndarray], table: Table, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Convert a checkpoint's tensors to parameters by dotted path, float32 (float64 is rounded).

    `source` has the tensors by their keys, `shapes` those of the network's parameters by dotted path.

    Raises:
        InputError: keys are missing or unknown, or a tensor has another shape or type.
    """
    parameters: dict[str, np.ndarray] = {}
    problems: list[str] = []
    for key, value in source.items():
        ignored = [shape for pattern, shape in table.ignored.items() if re.fullmatch(pattern, key)]
        if ignored or key.endswith(".num_batches_tracked"):
            if any(shape not in (None, value.shape) for shape in ignored):
                problems.append(f"{key} of another shape: expected {ignored[0]}, got {value.shape}")
            continue
        path = table.path_of(key, shapes)
        if not path or path in parameters:
            problems.append(f"{shorten(key)} {'twice' if path else 'unknown'}")
            continue
        parameters[path], problem = _convert_tensor(value, table, path, shapes[path])
        problems += [f"{key} {problem}"] if problem else []
    problems += [f"{path} missing" for path in shapes if path not in parameters]
    if problems:
        raise InputError(f"keys do not fit the network in {len(problems)} places: {'; '.join(problems[:3])}")
    return parameters


def _convert_tensor(value: np.ndarray, table: Table, path: str, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """The parameter of this shape, and what does not fit in a tensor; axes of length 1 do not count."""
    if value.dtype not in (np.float32, np.float64):
        return value, f"of another type: expected float32 or float64, got {value.dtype}"
    try:
        ordered = table.changes.get(path, np.asarray)(value)
        if axes := table.axes_of(path, len(shape)):
            ordered = ordered.reshape(ordered.shape[: len(axes)]).transpose(axes)
        if [side for side in ordered.shape if side != 1] == [side for side in shape if side != 1]:
            return np.array(ordered, np.float32, order="C").reshape(shape), ""
    except (ValueError, IndexError):  # another number of axes
        pass
    return value, f"of another shape: {value.shape} does not give {shape}"


RUNTIME = Table({"(.*)": r"\1"}, axes={".*": ()})  # runtime files have the networks' paths and layouts

_VGG_POSITIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # in the public Sequential, with pooling and ReLU
_VGG_NAMES = [f"conv{block}_{place + 1}" for block, count in enumerate((2, 2, 3, 3, 3), 1) for place in range(count)]


def _vgg(source: str, target: str = "vgg") -> dict[str, str]:
    places = zip(_VGG_POSITIONS, _VGG_NAMES, strict=True)
    return {rf"{source}\.{position}": f"{target}.{name}" for position, name in places}


D2NET = Table(_vgg(r"dense_feature_extraction\.model"))

SSM = Table(
    {r"(conv\d_\d)": r"vgg.\1"},
    ignored={  # layers behind the last map; ImageNet's networks have 1000 classes
        r"fc8\w*\.weights": (365, 4096),
        r"(conv5_3|fc[678]\w*)\.(weights|bias)": None,
    },
)


def _resnet(source: str, numbers: Sequence[int]) -> dict[str, str]:
    """Layers by their numbers in the file."""
    names = {}
    for layer, number in enumerate(numbers, 1):
        block, path = rf"{source}{number}\.(\d)", rf"backbone.layer{layer}.\1"
        names[rf"{block}\.((?:conv|bn)\d)"] = rf"{path}.\2"
        names |= {rf"{block}\.downsample\.0": f"{path}.shortcut", rf"{block}\.downsample\.1": f"{path}.shortcut_bn"}
    return names


MIXVPR = Table(
    {
        r"backbone\.model\.(conv1|bn1)": r"backbone.\1",
        **_resnet(r"backbone\.model\.layer", (1, 2, 3)),
        r"aggregator\.mix\.(\d)\.mix\.0": r"mix.\1.norm",
        r"aggregator\.mix\.(\d)\.mix\.1": r"mix.\1.linear1",
        r"aggregator\.mix\.(\d)\.mix\.3": r"mix.\1.linear2",
        r"aggregator\.(channel_proj|row_proj)": r"\1",
    }
)

EFFICIENTNET = Table(
    {
        "_conv_stem": "stem",
        "_bn0": "stem_bn",
        r"_blocks\.(\d+)\._expand_conv": r"blocks.\1.expand",
        r"_blocks\.(\d+)\._bn0": r"blocks.\1.expand_bn",
        r"_blocks\.(\d+)\._depthwise_conv\.weight": r"blocks.\1.depthwise",
        r"_blocks\.(\d+)\._bn1": r"blocks.\1.depthwise_bn",
        r"_blocks\.(\d+)\._project_conv": r"blocks.\1.project",
        r"_blocks\.(\d+)\._bn2": r"blocks.\1.project_bn",
    },
    ignored={r"(_conv_head|_bn1|_fc)\..*": None},  # layers behind the last block
    axes={r".*\.depthwise": _OF_KERNELS[4]},
)

ALIKED = Table(
    {
        r"(block\d\.conv\d|conv\d)(?:\.regular_conv)?": r"\1",  # regular_conv in deformable convolutions
        r"(block\d\.conv\d)\.offset_conv": r"\1.offset",
        r"(block\d\.bn\d)": r"\1",
        r"(block\d)\.downsample": r"\1.shortcut",
        **{rf"score_head\.{2 * place}": f"score_head.{place}" for place in range(4)},
        r"desc_head\.agg_weights": "desc_head.agg_weights",
        r"desc_head\.offset_conv\.0": "desc_head.offset1",
        r"desc_head\.offset_conv\.2": "desc_head.offset2",
        r"desc_head\.sf_conv": "desc_head.sample",
    }
)

XFEAT = Table(
    {
        r"skip1\.1": "skip1",
        r"(\w+\.\d)\.layer\.0": r"\1.conv",
        r"(\w+\.\d)\.layer\.1": r"\1.norm",
        r"(\w+\.\d)": r"\1",  # last layers
    },
    ignored={r"fine_matcher\..*": None},  # refines matches
)


def _attention(source: str, target: str, parts: dict[str, str]) -> dict[str, str]:
    layer = rf"(?:transformers\.(\d)\.{source}_attn|{source}_attn\.(\d))"  # the second form in older files
    parts = parts | {r"ffn\.0": "hidden", r"ffn\.1": "norm", r"ffn\.3": "update"}
    return {rf"{layer}\.{key}": rf"layers.\1\2.{target}.{path}" for key, path in parts.items()}


LIGHTGLUE = Table(
    {
        "input_proj": "input",
        r"posenc\.Wr": "position",
        **_attention("self", "within", {"Wqkv": "inputs.0", "out_proj": "message"}),
        **_attention("cross", "across", {"to_qk": "inputs.0", "to_v": "inputs.1", "to_out": "message"}),
        r"log_assignment\.(\d)\.final_proj": r"layers.\1.projection",
        r"log_assignment\.(\d)\.matchability": r"layers.\1.matchability",
        r"token_confidence\.(\d)\.token\.0": r"confidences.\1",
    },
    ignored={"confidence_thresholds": None},  # computed from the number of layers
)

# Patch-NetVLAD, and pytorch-NetVlad without the projection; training on several devices adds `module`.
NETVLAD = Table(
    {
        **_vgg(r"encoder(?:\.module)?"),
        r"pool(?:\.module)?\.conv": "pool.assignment",
        r"pool(?:\.module)?\.centroids": "pool.centers",
        r"WPCA\.0": "projection",
    }
)

# Layers of the original, with MATLAB's axes: height, width, inputs, outputs. The centers have the opposite sign.
NETVLAD_MATLAB = Table(
    {
        **{f"{layer}\\.weights": name for layer, name in _vgg(r"net\.layers").items()},
        r"net\.layers\.30\.weights\.0": "pool.assignment.kernel",
        r"net\.layers\.30\.weights\.1": "pool.centers",
        r"net\.layers\.33\.weights": "projection",
        r"net\.meta\.normalization\.averageImage": "average",
    },
    ignored={r"net\.(?!layers\.\d+\.weights|meta\.normalization\.averageImage).*": None},  # of the training
    axes={r"pool\.centers": LINEAR, ".*": ()},
    changes={"pool.centers": np.negative, "average": lambda image: image[0, 0]},
)

_GEM = {r"aggregation\.1\.p": "pool.power", r"aggregation\.3": "projection"}
GEM_VGG16 = Table(_vgg("backbone", "backbone") | _GEM)
GEM_RESNET50 = Table(
    {
        r"backbone\.0": "backbone.conv1",
        r"backbone\.1": "backbone.bn1",
        **_resnet(r"backbone\.", (4, 5, 6, 7)),
        **_GEM,
    }
)


def _transformer(source: str, target: str) -> dict[str, str]:
    block, path = rf"{source}blocks\.(\d+)", rf"{target}blocks.\1"
    return {
        rf"{source}cls_token": f"{target}first",
        rf"{source}pos_embed": f"{target}positions",
        rf"{source}register_tokens": f"{target}registers",
        rf"{source}patch_embed\.proj": f"{target}patches",
        rf"{block}\.attn\.qkv": f"{path}.attention.qkv",
        rf"{block}\.attn\.proj": f"{path}.attention.output",
        rf"{block}\.mlp\.fc1": f"{path}.perceptron.hidden",
        rf"{block}\.mlp\.fc2": f"{path}.perceptron.output",
        rf"{block}\.ls(\d)\.gamma": rf"{path}.scale\2",
        rf"{block}\.norm(\d)": rf"{path}.norm\2",
        rf"{source}norm": f"{target}norm",
    }


DINOV2 = Table(_transformer("", ""), ignored={"mask_token": None})  # of the training

# Training on several devices puts `module` before all keys.
_SELA, _BLOCK = r"(?:module\.)?", r"(?:module\.)?backbone\.blocks\.(\d+)"
SELAVPR = Table(
    {
        **_transformer(rf"{_SELA}backbone\.", "backbone."),
        rf"{_BLOCK}\.adapter1\.D_fc1": r"backbone.blocks.\1.serial.hidden",
        rf"{_BLOCK}\.adapter1\.D_fc2": r"backbone.blocks.\1.serial.output",
        rf"{_BLOCK}\.adapter2\.D_fc1": r"backbone.blocks.\1.parallel.hidden",
        rf"{_BLOCK}\.adapter2\.D_fc2": r"backbone.blocks.\1.parallel.output",
        rf"{_SELA}aggregation\.1\.p": "pool.power",
        rf"{_SELA}LocalAdapt\.upconv(\d)": r"upsampling\1",
    },
    ignored={rf"{_SELA}backbone\.mask_token": None},
    axes={r"upsampling\d\.kernel": UPSAMPLING},
)
