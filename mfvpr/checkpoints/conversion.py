"""Convert the tensors of published checkpoints to the parameters of our networks, by one table of keys per network.

The conversion is strict: each key is used once or listed as ignored, each parameter is set once, and all types and
shapes are checked.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError

# Axes of the source in our order.
CONV = (2, 3, 1, 0)  # OIHW -> HWIO
UPSAMPLING = (2, 3, 0, 1)  # a transposed convolution's IOHW -> HWIO
LINEAR = (1, 0)  # (out, in) -> (in, out), also of 1 x 1 convolutions


class Rule(NamedTuple):
    """Assign keys that fully match `source`, a regular expression, to `target`, a dotted path with its groups.

    `change` is applied first, then the order of `axes`. Axes of length 1 do not count.
    """

    source: str
    target: str
    axes: tuple[int, ...] = ()
    change: Callable[[np.ndarray], np.ndarray] = np.asarray


@dataclass(frozen=True)
class Table:
    """Rules for all keys of a network's checkpoint."""

    rules: tuple[Rule, ...]
    ignored: tuple[str, ...] = ()  # patterns of keys that the network does not need
    # Pattern -> required shape of ignored keys that identify this network's checkpoint.
    expected: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


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
        if any(re.fullmatch(pattern, key) for pattern in table.ignored):
            for pattern, shape in table.expected.items():
                if re.fullmatch(pattern, key) and value.shape != shape:
                    problems.append(f"{key} of another shape: expected {shape}, got {value.shape}")
            continue
        rules = [(match, rule) for rule in table.rules if (match := re.fullmatch(rule.source, key))]
        target = rules[0][0].expand(rules[0][1].target) if len(rules) == 1 else ""
        if target not in shapes or target in parameters:
            problems.append(f"{shorten(key)} {'twice' if target in parameters else 'unknown'}")
            continue
        parameters[target], problem = _convert_tensor(value, rules[0][1], shapes[target])
        problems += [f"{key} {problem}"] if problem else []
    problems += [f"{target} missing" for target in shapes if target not in parameters]
    if problems:
        raise InputError(f"keys do not fit the network in {len(problems)} places: {'; '.join(problems[:3])}")
    return parameters


def _convert_tensor(value: np.ndarray, rule: Rule, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """The parameter of this shape, and what does not fit in a tensor."""
    if value.dtype not in (np.float32, np.float64):
        return value, f"of another type: expected float32 or float64, got {value.dtype}"
    try:
        ordered = rule.change(value)
        if rule.axes:
            ordered = ordered.reshape(ordered.shape[: len(rule.axes)]).transpose(rule.axes)
        if [side for side in ordered.shape if side != 1] == [side for side in shape if side != 1]:
            return np.array(ordered, np.float32, order="C").reshape(shape), ""
    except (ValueError, IndexError):  # another number of axes
        pass
    return value, f"of another shape: {value.shape} does not give {shape}"


_COUNTERS = r".*\.num_batches_tracked"


def _linear(source: str, target: str, axes: tuple[int, ...] = LINEAR) -> tuple[Rule, ...]:
    return Rule(rf"{source}\.weight", f"{target}.kernel", axes), Rule(rf"{source}\.bias", f"{target}.bias")


_convolution = partial(_linear, axes=CONV)


def _norm(source: str, target: str) -> tuple[Rule, ...]:
    return Rule(rf"{source}\.weight", f"{target}.scale"), Rule(rf"{source}\.bias", f"{target}.bias")


def _batch_norm(source: str, target: str) -> tuple[Rule, ...]:
    statistics = {"running_mean": "mean", "running_var": "var"}
    rules = (Rule(rf"{source}\.{theirs}", f"{target}.{ours}") for theirs, ours in statistics.items())
    return *_norm(source, target), *rules


_VGG_POSITIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # in the public Sequential, with pooling and ReLU
_VGG_NAMES = [f"conv{block}_{place + 1}" for block, count in enumerate((2, 2, 3, 3, 3), 1) for place in range(count)]
_VGG = dict(zip(_VGG_POSITIONS, _VGG_NAMES, strict=True))


def _vgg(source: str, target: str = "vgg") -> tuple[Rule, ...]:
    layers = (_convolution(rf"{source}\.{position}", f"{target}.{name}") for position, name in _VGG.items())
    return tuple(chain.from_iterable(layers))


D2NET = Table(_vgg(r"dense_feature_extraction\.model"))

SSM = Table(
    (Rule(r"(conv\d_\d)\.weights", r"vgg.\1.kernel", CONV), Rule(r"(conv\d_\d)\.bias", r"vgg.\1.bias")),
    ignored=(r"(conv5_3|fc[678]\w*)\.(weights|bias)",),  # layers behind the last map
    expected={r"fc8\w*\.weights": (365, 4096)},  # ImageNet's networks have 1000 classes
)


def _resnet(conv1: str, bn1: str, layers: Mapping[str, str]) -> tuple[Rule, ...]:
    """Rules of a backbone; `layers` maps the file's names of layers to ours."""
    rules = [Rule(rf"{conv1}\.weight", "backbone.conv1.kernel", CONV), *_batch_norm(bn1, "backbone.bn1")]
    for source, layer in layers.items():
        block, ours = rf"{source}\.(\d)", rf"backbone.{layer}.\1"
        rules += [
            Rule(rf"{block}\.(conv\d)\.weight", rf"{ours}.\2.kernel", CONV),
            *_batch_norm(rf"{block}\.(bn\d)", rf"{ours}.\2"),
            Rule(rf"{block}\.downsample\.0\.weight", f"{ours}.shortcut.kernel", CONV),
            *_batch_norm(rf"{block}\.downsample\.1", f"{ours}.shortcut_bn"),
        ]
    return tuple(rules)


MIXVPR = Table(
    (
        *_resnet(
            r"backbone\.model\.conv1",
            r"backbone\.model\.bn1",
            {rf"backbone\.model\.layer{number}": f"layer{number}" for number in (1, 2, 3)},
        ),
        *_norm(r"aggregator\.mix\.(\d)\.mix\.0", r"mix.\1.norm"),
        *_linear(r"aggregator\.mix\.(\d)\.mix\.1", r"mix.\1.linear1"),
        *_linear(r"aggregator\.mix\.(\d)\.mix\.3", r"mix.\1.linear2"),
        *_linear(r"aggregator\.channel_proj", "channel_proj"),
        *_linear(r"aggregator\.row_proj", "row_proj"),
    ),
    ignored=(_COUNTERS,),
)

_CONV = r"(block\d\.conv\d|conv\d)"

ALIKED = Table(
    (
        Rule(rf"{_CONV}\.weight", r"\1.kernel", CONV),
        Rule(r"(block\d\.conv\d)\.regular_conv\.weight", r"\1.kernel", CONV),  # the deformable convolution's
        *_convolution(r"(block\d\.conv\d)\.offset_conv", r"\1.offset"),
        *_batch_norm(r"(block\d\.bn\d)", r"\1"),
        *_convolution(r"(block\d)\.downsample", r"\1.shortcut"),
        *(
            Rule(rf"score_head\.{position}\.weight", f"score_head.{place}.kernel", CONV)
            for place, position in enumerate((0, 2, 4, 6))
        ),
        Rule(r"desc_head\.agg_weights", "desc_head.agg_weights"),
        *_convolution(r"desc_head\.offset_conv\.0", "desc_head.offset1"),
        *_convolution(r"desc_head\.offset_conv\.2", "desc_head.offset2"),
        Rule(r"desc_head\.sf_conv\.weight", "desc_head.sample.kernel", CONV),
    ),
    ignored=(_COUNTERS,),
)

_LAYER = r"(?:transformers\.(\d)\.{0}_attn|{0}_attn\.(\d))"  # the second form in older files; one group is empty


def _attention(source: str, target: str, parts: dict[str, str]) -> tuple[Rule, ...]:
    layer, ours = _LAYER.format(source), rf"layers.\1\2.{target}"
    parts = parts | {r"ffn\.0": "hidden", r"ffn\.3": "update"}
    linear = (_linear(rf"{layer}\.{theirs}", f"{ours}.{name}") for theirs, name in parts.items())
    return *chain.from_iterable(linear), *_norm(rf"{layer}\.ffn\.1", f"{ours}.norm")


LIGHTGLUE = Table(
    (
        *_linear("input_proj", "input"),
        Rule(r"posenc\.Wr\.weight", "position.kernel", LINEAR),
        *_attention("self", "within", {"Wqkv": "inputs.0", "out_proj": "message"}),
        *_attention("cross", "across", {"to_qk": "inputs.0", "to_v": "inputs.1", "to_out": "message"}),
        *_linear(r"log_assignment\.(\d)\.final_proj", r"layers.\1.projection"),
        *_linear(r"log_assignment\.(\d)\.matchability", r"layers.\1.matchability"),
        *_linear(r"token_confidence\.(\d)\.token\.0", r"confidences.\1"),
    ),
    ignored=("confidence_thresholds",),  # computed from the number of layers
)

# Patch-NetVLAD, and pytorch-NetVlad without the projection; training on several devices adds `module`.
NETVLAD = Table(
    (
        *_vgg(r"encoder(?:\.module)?"),
        Rule(r"pool(?:\.module)?\.conv\.weight", "pool.assignment.kernel", LINEAR),
        Rule(r"pool(?:\.module)?\.centroids", "pool.centers"),
        *_linear(r"WPCA\.0", "projection"),
    )
)

# Layers of the original, with MATLAB's axes: height, width, inputs, outputs. The centers have the opposite sign.
NETVLAD_MATLAB = Table(
    (
        *(
            Rule(rf"net\.layers\.{position}\.weights\.{place}", f"vgg.{name}.{part}")
            for position, name in _VGG.items()
            for place, part in enumerate(("kernel", "bias"))
        ),
        Rule(r"net\.layers\.30\.weights\.0", "pool.assignment.kernel"),
        Rule(r"net\.layers\.30\.weights\.1", "pool.centers", LINEAR, np.negative),
        Rule(r"net\.layers\.33\.weights\.0", "projection.kernel"),
        Rule(r"net\.layers\.33\.weights\.1", "projection.bias"),
        Rule(r"net\.meta\.normalization\.averageImage", "average", change=lambda image: image[0, 0]),
    ),
    ignored=(r"net\.(?!layers\.\d+\.weights|meta\.normalization\.averageImage).*",),  # settings of the training
)

_GEM = (Rule(r"aggregation\.1\.p", "pool.power"), *_linear(r"aggregation\.3", "projection"))
GEM_VGG16 = Table((*_vgg("backbone", "backbone"), *_GEM))
GEM_RESNET50 = Table(
    (
        *_resnet(
            r"backbone\.0", r"backbone\.1", {rf"backbone\.{place}": f"layer{place - 3}" for place in (4, 5, 6, 7)}
        ),
        *_GEM,
    ),
    ignored=(_COUNTERS,),
)


def _transformer(source: str, target: str) -> tuple[Rule, ...]:
    block, ours = rf"{source}blocks\.(\d+)", rf"{target}blocks.\1"
    return (
        Rule(rf"{source}cls_token", f"{target}first"),
        Rule(rf"{source}pos_embed", f"{target}positions"),
        Rule(rf"{source}register_tokens", f"{target}registers"),
        *_convolution(rf"{source}patch_embed\.proj", f"{target}patches"),
        *_linear(rf"{block}\.attn\.qkv", f"{ours}.attention.qkv"),
        *_linear(rf"{block}\.attn\.proj", f"{ours}.attention.output"),
        *_linear(rf"{block}\.mlp\.fc1", f"{ours}.perceptron.hidden"),
        *_linear(rf"{block}\.mlp\.fc2", f"{ours}.perceptron.output"),
        Rule(rf"{block}\.ls(\d)\.gamma", rf"{ours}.scale\2"),
        *_norm(rf"{block}\.norm(\d)", rf"{ours}.norm\2"),
        *_norm(rf"{source}norm", f"{target}norm"),
    )


_MASK = "mask_token"  # of the training

DINOV2 = Table(_transformer("", ""), ignored=(_MASK,))

# Training on several devices puts `module` before all keys.
_SELA, _BLOCK = r"(?:module\.)?", r"backbone\.blocks\.(\d+)"
SELAVPR = Table(
    (
        *_transformer(rf"{_SELA}backbone\.", "backbone."),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter1\.D_fc1", r"backbone.blocks.\1.serial.hidden"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter1\.D_fc2", r"backbone.blocks.\1.serial.output"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter2\.D_fc1", r"backbone.blocks.\1.parallel.hidden"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter2\.D_fc2", r"backbone.blocks.\1.parallel.output"),
        Rule(rf"{_SELA}aggregation\.1\.p", "pool.power"),
        *_linear(rf"{_SELA}LocalAdapt\.upconv(\d)", r"upsampling\1", UPSAMPLING),
    ),
    ignored=(rf"{_SELA}backbone\.{_MASK}",),
)
