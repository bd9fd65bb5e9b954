"""Tables from the keys of published checkpoints to the parameters of our networks."""

from collections.abc import Mapping
from functools import partial
from itertools import chain

from mfvpr.checkpoints.conversion import Layout, Rule, Table

_COUNTERS = r".*\.num_batches_tracked"


def _linear(source: str, target: str, layout: Layout = Layout.LINEAR) -> tuple[Rule, ...]:
    return Rule(rf"{source}\.weight", f"{target}.kernel", layout), Rule(rf"{source}\.bias", f"{target}.bias")


_convolution = partial(_linear, layout=Layout.CONV)


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

# SSM-VPR's file, and torch files of the same Caffe model with the names of Caffe or torchvision.
SSM = Table(
    (
        Rule(r"(conv\d_\d)\.weights?", r"vgg.\1.kernel", Layout.CONV),
        Rule(r"(conv\d_\d)\.bias", r"vgg.\1.bias", Layout.SQUEEZED),
        *_vgg("features"),
    ),
    ignored=(  # layers behind the last map
        r"(conv5_3|fc[678]\w*)\.(weights?|bias)",
        r"(features\.28|classifier\.\d)\.(weight|bias)",
    ),
    expected={r"fc8\w*\.weights?|classifier\.6\.weight": (365, 4096)},  # ImageNet's networks have 1000 classes
)


def _resnet(conv1: str, bn1: str, layers: Mapping[str, str]) -> tuple[Rule, ...]:
    """Rules of a backbone; `layers` maps the file's names of layers to ours."""
    rules = [Rule(rf"{conv1}\.weight", "backbone.conv1.kernel", Layout.CONV), *_batch_norm(bn1, "backbone.bn1")]
    for source, layer in layers.items():
        block, ours = rf"{source}\.(\d)", rf"backbone.{layer}.\1"
        rules += [
            Rule(rf"{block}\.(conv\d)\.weight", rf"{ours}.\2.kernel", Layout.CONV),
            *_batch_norm(rf"{block}\.(bn\d)", rf"{ours}.\2"),
            Rule(rf"{block}\.downsample\.0\.weight", f"{ours}.shortcut.kernel", Layout.CONV),
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
        Rule(rf"{_CONV}\.weight", r"\1.kernel", Layout.CONV),
        Rule(r"(block\d\.conv\d)\.regular_conv\.weight", r"\1.kernel", Layout.CONV),  # the deformable convolution's
        *_convolution(r"(block\d\.conv\d)\.offset_conv", r"\1.offset"),
        *_batch_norm(r"(block\d\.bn\d)", r"\1"),
        *_convolution(r"(block\d)\.downsample", r"\1.shortcut"),
        *(
            Rule(rf"score_head\.{position}\.weight", f"score_head.{place}.kernel", Layout.CONV)
            for place, position in enumerate((0, 2, 4, 6))
        ),
        Rule(r"desc_head\.agg_weights", "desc_head.agg_weights"),
        *_convolution(r"desc_head\.offset_conv\.0", "desc_head.offset1"),
        *_convolution(r"desc_head\.offset_conv\.2", "desc_head.offset2"),
        Rule(r"desc_head\.sf_conv\.weight", "desc_head.sample.kernel", Layout.CONV),
    ),
    ignored=(_COUNTERS,),
)

_LAYER = r"(?:transformers\.(\d)\.{0}_attn|{0}_attn\.(\d))"  # the second form in older files; one group is empty


def _attention(source: str, target: str, parts: dict[str, str]) -> tuple[Rule, ...]:
    layer, ours = _LAYER.format(source), rf"layers.\1\2.{target}"
    parts = parts | {r"ffn\.0": "feed_forward.hidden", r"ffn\.3": "feed_forward.update"}
    linear = (_linear(rf"{layer}\.{theirs}", f"{ours}.{name}") for theirs, name in parts.items())
    return *chain.from_iterable(linear), *_norm(rf"{layer}\.ffn\.1", f"{ours}.feed_forward.norm")


LIGHTGLUE = Table(
    (
        *_linear("input_proj", "input"),
        Rule(r"posenc\.Wr\.weight", "position.kernel", Layout.LINEAR),
        *_attention("self", "self_attention", {"Wqkv": "qkv", "out_proj": "message"}),
        *_attention("cross", "cross_attention", {"to_qk": "key", "to_v": "value", "to_out": "message"}),
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
        Rule(r"pool(?:\.module)?\.conv\.weight", "pool.assignment.kernel", Layout.POINTWISE),
        Rule(r"pool(?:\.module)?\.centroids", "pool.centers"),
        *_linear(r"WPCA\.0", "projection", Layout.POINTWISE),
    )
)

# Layers of the original, with MATLAB's axes: height, width, inputs, outputs. The centers have the opposite sign.
NETVLAD_MATLAB = Table(
    (
        *(
            Rule(rf"net\.layers\.{position}\.weights\.{place}", f"vgg.{name}.{part}", Layout.SQUEEZED)
            for position, name in _VGG.items()
            for place, part in enumerate(("kernel", "bias"))
        ),
        Rule(r"net\.layers\.30\.weights\.0", "pool.assignment.kernel", Layout.SQUEEZED),
        Rule(r"net\.layers\.30\.weights\.1", "pool.centers", Layout.OPPOSITE),
        Rule(r"net\.layers\.33\.weights\.0", "projection.kernel", Layout.SQUEEZED),
        Rule(r"net\.layers\.33\.weights\.1", "projection.bias", Layout.SQUEEZED),
        Rule(r"net\.meta\.normalization\.averageImage", "average", Layout.PIXEL),
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
        Rule(rf"{source}cls_token", f"{target}first", Layout.SQUEEZED),
        Rule(rf"{source}pos_embed", f"{target}positions", Layout.SQUEEZED),
        Rule(rf"{source}register_tokens", f"{target}registers", Layout.SQUEEZED),
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
        *_linear(rf"{_SELA}{_BLOCK}\.adapter1\.D_fc1", r"backbone.blocks.\1.serial.down"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter1\.D_fc2", r"backbone.blocks.\1.serial.up"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter2\.D_fc1", r"backbone.blocks.\1.parallel.down"),
        *_linear(rf"{_SELA}{_BLOCK}\.adapter2\.D_fc2", r"backbone.blocks.\1.parallel.up"),
        Rule(rf"{_SELA}aggregation\.1\.p", "pool.power"),
        *_linear(rf"{_SELA}LocalAdapt\.upconv(\d)", r"upsampling\1", Layout.UPSAMPLING),
    ),
    ignored=(rf"{_SELA}backbone\.{_MASK}",),
)
