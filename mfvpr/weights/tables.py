"""Keys of the published checkpoints -> paths of our networks."""

from mfvpr.weights.conversion import Layout, Rule, Table

_COUNTERS = r".*\.num_batches_tracked"


def _batch_norm(source: str, target: str) -> tuple[Rule, ...]:
    names = {"weight": "scale", "bias": "bias", "running_mean": "mean", "running_var": "var"}
    return tuple(Rule(rf"{source}\.{theirs}", f"{target}.{ours}") for theirs, ours in names.items())


def _linear(source: str, target: str) -> tuple[Rule, ...]:
    return Rule(rf"{source}\.weight", f"{target}.kernel", Layout.LINEAR), Rule(rf"{source}\.bias", f"{target}.bias")


def _convolution(source: str, target: str) -> tuple[Rule, ...]:
    return (
        Rule(rf"{source}\.weight", f"{target}.kernel", Layout.CONV),
        Rule(rf"{source}\.bias", f"{target}.bias"),
    )


# Positions of VGG16's convolutions in the public Sequential; pooling and ReLU lie between.
_VGG = {
    0: "conv1_1", 2: "conv1_2", 5: "conv2_1", 7: "conv2_2", 10: "conv3_1", 12: "conv3_2", 14: "conv3_3",
    17: "conv4_1", 19: "conv4_2", 21: "conv4_3", 24: "conv5_1", 26: "conv5_2", 28: "conv5_3",
}  # fmt: skip


def _vgg(source: str) -> tuple[Rule, ...]:
    layers = (_convolution(rf"{source}\.{position}", f"vgg.{name}") for position, name in _VGG.items())
    return tuple(rule for rules in layers for rule in rules)


D2NET = Table(_vgg(r"dense_feature_extraction\.model"))

# SSM-VPR's own file and torch files of the same Caffe model, with Caffe's names or with torchvision's.
SSM = Table(
    (
        Rule(r"(conv\d_\d)\.weights?", r"vgg.\1.kernel", Layout.CONV),
        Rule(r"(conv\d_\d)\.bias", r"vgg.\1.bias", Layout.VECTOR),
        *_vgg("features"),
    ),
    ignored=(  # layers behind the last map
        r"(conv5_3|fc[678]\w*)\.(weights?|bias)",
        r"(features\.28|classifier\.\d)\.(weight|bias)",
    ),
    expected={r"fc8\w*\.weights?|classifier\.6\.weight": (365, 4096)},  # ImageNet's networks have 1000 classes
)

_BLOCK = r"backbone\.model\.(layer\d\.\d)"

MIXVPR = Table(
    (
        Rule(r"backbone\.model\.conv1\.weight", "backbone.conv1.kernel", Layout.CONV),
        *_batch_norm(r"backbone\.model\.bn1", "backbone.bn1"),
        Rule(rf"{_BLOCK}\.(conv\d)\.weight", r"backbone.\1.\2.kernel", Layout.CONV),
        *_batch_norm(rf"{_BLOCK}\.(bn\d)", r"backbone.\1.\2"),
        Rule(rf"{_BLOCK}\.downsample\.0\.weight", r"backbone.\1.shortcut.kernel", Layout.CONV),
        *_batch_norm(rf"{_BLOCK}\.downsample\.1", r"backbone.\1.shortcut_bn"),
        Rule(r"aggregator\.mix\.(\d)\.mix\.0\.weight", r"mix.\1.norm.scale"),
        Rule(r"aggregator\.mix\.(\d)\.mix\.0\.bias", r"mix.\1.norm.bias"),
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
        Rule(r"(block\d\.conv\d)\.offset_conv\.weight", r"\1.offset.kernel", Layout.CONV),
        Rule(r"(block\d\.conv\d)\.offset_conv\.bias", r"\1.offset.bias"),
        *_batch_norm(r"(block\d\.bn\d)", r"\1"),
        Rule(r"(block\d)\.downsample\.weight", r"\1.shortcut.kernel", Layout.CONV),
        Rule(r"(block\d)\.downsample\.bias", r"\1.shortcut.bias"),
        *(
            Rule(rf"score_head\.{position}\.weight", f"score_head.{place}.kernel", Layout.CONV)
            for place, position in enumerate((0, 2, 4, 6))
        ),
        Rule(r"desc_head\.agg_weights", "desc_head.agg_weights"),
        Rule(r"desc_head\.offset_conv\.0\.weight", "desc_head.offset1.kernel", Layout.CONV),
        Rule(r"desc_head\.offset_conv\.0\.bias", "desc_head.offset1.bias"),
        Rule(r"desc_head\.offset_conv\.2\.weight", "desc_head.offset2.kernel", Layout.CONV),
        Rule(r"desc_head\.offset_conv\.2\.bias", "desc_head.offset2.bias"),
        Rule(r"desc_head\.sf_conv\.weight", "desc_head.sample.kernel", Layout.CONV),
    ),
    ignored=(_COUNTERS,),
)

_LAYER = r"(?:transformers\.(\d)\.{0}_attn|{0}_attn\.(\d))"  # the latter in older files; the other group is empty


def _attention(source: str, target: str, parts: dict[str, str]) -> tuple[Rule, ...]:
    layer, ours = _LAYER.format(source), rf"layers.\1\2.{target}"
    parts = parts | {r"ffn\.0": "feed_forward.hidden", r"ffn\.3": "feed_forward.update"}
    linear = (_linear(rf"{layer}\.{theirs}", f"{ours}.{name}") for theirs, name in parts.items())
    norm = rf"{layer}\.ffn\.1", f"{ours}.feed_forward.norm"
    return (
        *(rule for rules in linear for rule in rules),
        Rule(rf"{norm[0]}\.weight", f"{norm[1]}.scale"),
        Rule(rf"{norm[0]}\.bias", f"{norm[1]}.bias"),
    )


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
    ignored=("confidence_thresholds",),  # follow from the number of layers
)
