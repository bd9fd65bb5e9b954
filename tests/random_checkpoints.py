"""Checkpoints without torch: a writer of its files, byte by byte; random weights under the public names and shapes."""

import io
import itertools
import math
import pickle
import struct
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.io import savemat

KINDS = {"f4": "FloatStorage", "f8": "DoubleStorage", "f2": "HalfStorage", "i8": "LongStorage"}
Shapes = dict[str, tuple[int, ...]]


class Global(NamedTuple):
    """A name that a pickle asks for."""

    module: str
    name: str


class _Pickler(pickle._Pickler):  # type: ignore
    """Pickles as torch does; the arrays of tensors gather in `storages`."""

    def __init__(self, file: io.BytesIO, *, legacy: bool = False) -> None:
        super().__init__(file, protocol=2)
        self.storages: dict[str, np.ndarray] = {}
        self.legacy = legacy

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, Global):
            self.write(f"c{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, np.ndarray):
            key, kind = str(len(self.storages)), Global("torch", KINDS[obj.dtype.str[1:]])
            self.storages[key] = obj
            self.save(Global("torch._utils", "_rebuild_tensor_v2"))
            self.write(pickle.MARK)
            self.save(("storage", kind, key, "cpu", obj.size, *[None] * self.legacy))
            self.write(pickle.BINPERSID)
            strides = tuple(step // obj.itemsize for step in obj.strides)
            for part in (0, obj.shape, strides, False, OrderedDict()):
                self.save(part)
            self.write(pickle.TUPLE + pickle.REDUCE)
        else:
            super().save(obj, save_persistent_id)


def pickled(content: Any, *, legacy: bool = False) -> tuple[bytes, dict[str, np.ndarray]]:
    """A pickle, and the arrays of its tensors by key."""
    file = io.BytesIO()
    pickler = _Pickler(file, legacy=legacy)
    pickler.dump(content)
    return file.getvalue(), pickler.storages


def write_zip(path: Path, content: Any, *, order: str = "little", compression: int = zipfile.ZIP_STORED) -> Path:
    """A checkpoint as torch has written them since 1.6."""
    data, storages = pickled(content)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{path.stem}/data.pkl", data)
        archive.writestr(f"{path.stem}/byteorder", order)
        for key, array in storages.items():
            archive.writestr(f"{path.stem}/data/{key}", array.astype(array.dtype.newbyteorder(order)).tobytes("A"))
        archive.writestr(f"{path.stem}/version", "3\n")
    return path


def write_legacy(path: Path, content: Any) -> Path:
    """A checkpoint as torch wrote them before."""
    system = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}
    data, storages = pickled(content, legacy=True)
    parts = [pickled(0x1950A86A20F9469CFC6C)[0], pickled(1001)[0], pickled(system)[0], data, pickled([*storages])[0]]
    parts += [struct.pack("<q", array.size) + array.tobytes("A") for array in storages.values()]
    path.write_bytes(b"".join(parts))
    return path


def write_numpy(path: Path, content: Any, *, protocol: int = 4) -> Path:
    """A .npy file of one pickled object, as NumPy writes it; `content` may be the bytes of the pickle."""
    start = "{'descr': '|O', 'fortran_order': False, 'shape': (), }".ljust(117) + "\n"
    if not isinstance(content, bytes):
        content = pickle.dumps(np.array(content, dtype=object), protocol=protocol)
    path.write_bytes(b"\x93NUMPY\x01\0" + struct.pack("<H", len(start)) + start.encode() + content)
    return path


def layered(tensors: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """`layer.name` -> layer -> name, as SSM-VPR's .npy files have it."""
    layers: dict[str, dict[str, np.ndarray]] = {}
    for key, array in tensors.items():
        layer, _, name = key.partition(".")
        layers.setdefault(layer, {})[name] = array
    return layers


def random_checkpoint(shapes: Shapes, seed: int = 0) -> dict[str, np.ndarray]:
    """Plausible weights: each depends on its name, its shape and the seed alone."""
    return {name: _random(name, shape, seed) for name, shape in shapes.items()}


def _random(name: str, shape: tuple[int, ...], seed: int) -> np.ndarray:
    if name.endswith("num_batches_tracked"):
        return np.full(shape, 1000, np.int64)
    if name.endswith("aggregation.1.p"):
        return np.float32([2.875])
    normal = np.random.default_rng([seed, zlib.crc32(name.encode())]).standard_normal(shape)
    if name.endswith("running_var"):
        values = 1 + 0.5 * np.tanh(normal)
    elif name.endswith(("bias", "running_mean")):
        values = 0.05 * normal
    elif len(shape) < 2:  # the scale of a normalization
        values = 1 + 0.1 * normal
    else:  # He et al.: keeps the variance through a ReLU
        values = math.sqrt(2 / math.prod(shape[1:])) * normal
    tensor = values.astype(np.float32)
    if name.endswith(("pos_embed", "register_tokens")):  # they count as much as patches do
        return tensor / tensor.std() / 2
    return 40 * tensor if name == "pool.conv.weight" else tensor  # NetVLAD assigns more decidedly


def for_networks() -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """(name of published weights, random tensors)."""
    yield "d2_tf", random_checkpoint(d2net_shapes())
    yield "mixvpr_4096", random_checkpoint(mixvpr_shapes())
    yield "vgg16_places365", random_checkpoint(places365_shapes(full=False))
    yield "patchnetvlad_mapillary_128", random_checkpoint(netvlad_shapes(16, 128))
    yield "cosplace_vgg16_512", random_checkpoint(gem_shapes("vgg16", 512))
    yield "aliked-n16", random_checkpoint(aliked_shapes((16, 32, 64, 128), 128))
    yield "aliked_lightglue", random_checkpoint(lightglue_shapes())
    yield "efficientnet_lite0", random_checkpoint(efficientnet_shapes())
    yield "xfeat", random_checkpoint(xfeat_shapes())


def with_biases(weights: Shapes) -> Shapes:
    """Shapes of layers' weights, each followed by that of the bias."""
    parts = {name: {"weight": weight, "bias": weight[:1]} for name, weight in weights.items()}
    return {f"{name}.{part}": shape for name, both in parts.items() for part, shape in both.items()}


def _norms(widths: dict[str, int]) -> Shapes:
    """Shapes of batch normalizations."""
    names = ("weight", "bias", "running_mean", "running_var")
    shapes = {f"{layer}.{name}": (width,) for layer, width in widths.items() for name in names}
    return shapes | {f"{layer}.num_batches_tracked": () for layer in widths}


_POSITIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # of VGG16's convolutions in torch's networks
_WIDTHS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
_VGG16 = dict(zip(_POSITIONS, pairwise(_WIDTHS), strict=True))


def _vgg16(prefix: str, last: int = 28) -> Shapes:
    weights = {f"{prefix}.{index}": (*widths[::-1], 3, 3) for index, widths in _VGG16.items() if index <= last}
    return with_biases(weights)


def d2net_shapes() -> Shapes:
    """The tensors of d2_tf.pth, which holds them below the key `model`."""
    return _vgg16("dense_feature_extraction.model", last=21)


def places365_shapes(*, full: bool = True) -> Shapes:
    """The tensors of vgg16_places365.npy; those SSM-VPR needs unless `full`."""
    names = (f"conv{block}_{place}" for block, count in enumerate((2, 2, 3, 3, 3), 1) for place in range(1, count + 1))
    shapes = {name: (*widths[::-1], 3, 3) for name, widths in zip(names, _VGG16.values(), strict=True)}
    if full:
        shapes |= {"fc6_1": (4096, 25_088), "fc7_1": (4096, 4096), "fc8a_1": (365, 4096)}
    else:
        del shapes["conv5_3"]
    return {name.replace("weight", "weights"): shape for name, shape in with_biases(shapes).items()}


def netvlad_shapes(clusters: int = 16, outputs: int | None = 4096) -> Shapes:
    """The tensors of Patch-NetVLAD's checkpoints; without `outputs` those of pytorch-NetVlad's."""
    shapes = _vgg16("encoder") | {"pool.conv.weight": (clusters, 512, 1, 1), "pool.centroids": (clusters, 512)}
    return shapes | (with_biases({"WPCA.0": (outputs, 512 * clusters, 1, 1)}) if outputs else {})


def gem_shapes(backbone: str = "resnet50", outputs: int = 2048) -> Shapes:
    """The tensors of CosPlace's checkpoints."""
    if backbone == "vgg16":
        shapes, channels = _vgg16("backbone"), 512
    else:
        shapes, channels = _resnet50("backbone.0", "backbone.1", [f"backbone.{place}" for place in (4, 5, 6, 7)]), 2048
    return shapes | {"aggregation.1.p": (1,)} | with_biases({"aggregation.3": (outputs, channels)})


def dinov2_shapes(width: int, depth: int, registers: int = 0, prefix: str = "", *, adapted: bool = False) -> Shapes:
    """The tensors of DINOv2's checkpoints; `adapted` those of SelaVPR's backbone."""
    shapes = {"cls_token": (1, 1, width), "pos_embed": (1, 1370, width), "mask_token": (1, width)}
    if registers:
        shapes["register_tokens"] = (1, registers, width)
    weights = {"patch_embed.proj": (width, 3, 14, 14), "norm": (width,)}
    of_block = {"attn.qkv": (3 * width, width), "attn.proj": (width, width), "norm1": (width,), "norm2": (width,)}
    of_block |= {"mlp.fc1": (4 * width, width), "mlp.fc2": (width, 4 * width)}
    for number in (1, 2) if adapted else ():
        adapter = f"adapter{number}.D_fc"
        of_block |= {f"{adapter}1": (width // 2, width), f"{adapter}2": (width, width // 2)}
    for place in range(depth):
        weights |= {f"blocks.{place}.{name}": shape for name, shape in of_block.items()}
        shapes |= {f"blocks.{place}.ls{number}.gamma": (width,) for number in (1, 2)}
    return {f"{prefix}{name}": shape for name, shape in (shapes | with_biases(weights)).items()}


def selavpr_shapes(width: int = 1024, depth: int = 24, registers: int = 0, prefix: str = "module.") -> Shapes:
    """The tensors of SelaVPR's checkpoints, which hold them below `model_state_dict`."""
    head: Shapes = {"aggregation.1.p": (1,)}
    for number, inputs, outputs in ((1, width, 256), (2, 256, 128)):  # transposed convolutions
        layer = f"LocalAdapt.upconv{number}"
        head |= {f"{layer}.weight": (inputs, outputs, 3, 3), f"{layer}.bias": (outputs,)}
    backbone = dinov2_shapes(width, depth, registers, f"{prefix}backbone.", adapted=True)
    return backbone | {f"{prefix}{name}": shape for name, shape in head.items()}


def matlab_shapes(clusters: int = 64, outputs: int = 4096) -> Shapes:
    """The arrays of the original's files, as they are read."""
    weights = {}
    for position, (inputs, channels) in _VGG16.items():
        weights |= {f"{position}.weights.0": (3, 3, inputs, channels), f"{position}.weights.1": (1, channels)}
    weights |= {"30.weights.0": (512, clusters), "30.weights.1": (512, clusters)}
    weights |= {"33.weights.0": (1, 1, 512 * clusters, outputs), "33.weights.1": (1, outputs)}
    shapes = {f"net.layers.{name}": shape for name, shape in weights.items()}
    return shapes | {"net.meta.normalization.averageImage": (6, 5, 3), "net.meta.normalization.imageSize": (1, 3)}


def matlab_netvlad(clusters: int = 64, outputs: int = 4096, seed: int = 0) -> dict[str, Any]:
    """Content of the original's files, as SciPy writes it: `net.layers{i}.weights{j}` and the average image."""
    tensors = random_checkpoint(netvlad_shapes(clusters, outputs), seed)
    weights = {
        position: [
            tensors[f"encoder.{position}.weight"].transpose(2, 3, 1, 0),
            tensors[f"encoder.{position}.bias"][None],
        ]
        for position in _VGG16
    }
    weights[30] = [tensors["pool.conv.weight"][:, :, 0, 0].T, -tensors["pool.centroids"].T]
    weights[33] = [tensors["WPCA.0.weight"][:, :, 0, 0].T[None, None], tensors["WPCA.0.bias"][None]]
    layers = [{"name": f"layer{position}", "type": "relu"} for position in range(35)]
    for position, arrays in weights.items():
        layers[position] |= {"type": "conv", "weights": cell(arrays)}
    average = np.broadcast_to(np.float32([123.68, 116.779, 103.939]), (6, 5, 3)).copy()
    meta = {"normalization": {"averageImage": average, "imageSize": np.float64([[5, 6, 3]])}, "classes": "none"}
    return {"net": {"layers": cell(layers), "meta": meta}}


def cell(parts: list[Any]) -> np.ndarray:
    cell = np.empty((1, len(parts)), object)
    for place, part in enumerate(parts):
        cell[0, place] = part
    return cell


def write_matlab(path: Path, content: dict[str, Any], *, packed: bool = True) -> Path:
    """A .mat file of version 5."""
    savemat(path, content, do_compression=packed)
    return path


def mixvpr_shapes(out_channels: int = 1024, out_rows: int = 4) -> Shapes:
    """The tensors of MixVPR's checkpoints: ResNet-50 to its third layer, the mixer, two projections."""
    backbone = "backbone.model"
    shapes = _resnet50(f"{backbone}.conv1", f"{backbone}.bn1", [f"{backbone}.layer{layer}" for layer in (1, 2, 3)])
    weights = {"aggregator.channel_proj": (out_channels, 1024), "aggregator.row_proj": (out_rows, 400)}
    for mixer in (f"aggregator.mix.{place}.mix" for place in range(4)):
        weights |= {f"{mixer}.0": (400,), f"{mixer}.1": (400, 400), f"{mixer}.3": (400, 400)}
    return shapes | with_biases(weights)


def _resnet50(conv1: str, bn1: str, layers: list[str]) -> Shapes:
    """The tensors of ResNet-50 with these names; fewer than four layers are the first."""
    weights: Shapes = {conv1: (64, 3, 7, 7)}
    norms, inputs = {bn1: 64}, 64
    for layer, blocks, width in zip(layers, (3, 4, 6, 3), (64, 128, 256, 512), strict=False):
        for prefix in (f"{layer}.{block}" for block in range(blocks)):
            sizes = ((width, inputs, 1, 1), (width, width, 3, 3), (4 * width, width, 1, 1))
            for index, size in enumerate(sizes, start=1):
                weights[f"{prefix}.conv{index}"], norms[f"{prefix}.bn{index}"] = size, size[0]
            if prefix == f"{layer}.0":
                weights[f"{prefix}.downsample.0"] = (4 * width, inputs, 1, 1)
                norms[f"{prefix}.downsample.1"] = 4 * width
            inputs = 4 * width
    return {f"{name}.weight": shape for name, shape in weights.items()} | _norms(norms)


def lightglue_shapes(inputs: int = 128, width: int = 256, layers: int = 9, heads: int = 4) -> Shapes:
    """The tensors of LightGlue's checkpoints for features without orientations, such as aliked_lightglue.pth."""
    square, wide = (width, width), 2 * width
    update = {"ffn.0": (wide, wide), "ffn.1": (wide,), "ffn.3": (width, wide)}
    kinds = {
        "self_attn": {"Wqkv": (3 * width, width), "out_proj": square, **update},
        "cross_attn": {"to_qk": square, "to_v": square, "to_out": square, **update},
    }
    weights = {"input_proj": (width, inputs)}
    for layer in range(layers):
        for kind, parts in kinds.items():
            weights |= {f"transformers.{layer}.{kind}.{name}": shape for name, shape in parts.items()}
        assignment = f"log_assignment.{layer}"
        weights |= {f"{assignment}.final_proj": square, f"{assignment}.matchability": (1, width)}
    weights |= {f"token_confidence.{layer}.token.0": (1, width) for layer in range(layers - 1)}
    return {"posenc.Wr.weight": (width // heads // 2, 2)} | with_biases(weights)


def aliked_shapes(widths: tuple[int, ...] = (8, 16, 32, 64), dimension: int = 64, positions: int = 16) -> Shapes:
    """The tensors of ALIKED's checkpoints, by default of aliked-t16."""
    head, moves = "desc_head", 2 * positions
    plain = {f"{head}.sf_conv": (dimension, dimension, 1, 1)}
    biased = {f"{head}.offset_conv.0": (moves, dimension, 3, 3), f"{head}.offset_conv.2": (moves, moves, 1, 1)}
    norms = {}
    for block, (inputs, outputs) in enumerate(pairwise((3, *widths)), start=1):
        for place, channels in ((1, inputs), (2, outputs)):
            conv = f"block{block}.conv{place}"
            if block > 2:
                biased[f"{conv}.offset_conv"] = (18, channels, 3, 3)
                conv += ".regular_conv"
            plain[conv], norms[f"block{block}.bn{place}"] = (outputs, channels, 3, 3), outputs
        if block > 1:
            biased[f"block{block}.downsample"] = (outputs, inputs, 1, 1)
        plain[f"conv{block}"] = (dimension // 4, outputs, 1, 1)
    for place, size in {0: (8, dimension, 1, 1), 2: (4, 8, 3, 3), 4: (4, 4, 3, 3), 6: (1, 4, 3, 3)}.items():
        plain[f"score_head.{place}"] = size
    shapes = {f"{name}.weight": shape for name, shape in plain.items()} | with_biases(biased) | _norms(norms)
    return shapes | {f"{head}.agg_weights": (positions, dimension, dimension)}


def xfeat_shapes() -> Shapes:
    """The tensors of xfeat.pt, but for most of the refinement of matches."""
    widths = {"block1": (1, 4, 8, 8, 24), "block2": (24,) * 3, "block3": (24, 64, 64, 64), "block4": (64,) * 4}
    widths |= {"block5": (64, 128, 128, 128, 64), "block_fusion": (64,) * 3}
    widths |= {"heatmap_head": (64,) * 3, "keypoint_head": (64,) * 4}
    shapes: Shapes = {}
    for stack, layers in widths.items():
        for place, (inputs, outputs) in enumerate(pairwise(layers)):
            layer = f"{stack}.{place}"
            size = 1 if "head" in stack or layer in ("block3.2", "block5.3") else 3
            shapes[f"{layer}.layer.0.weight"] = (outputs, inputs, size, size)
            shapes |= {f"{layer}.layer.1.running_{name}": (outputs,) for name in ("mean", "var")}
    last: Shapes = {"skip1.1": (24, 1, 1, 1), "keypoint_head.3": (65, 64, 1, 1), "fine_matcher.0": (512, 128)}
    return shapes | with_biases(last | {"block_fusion.2": (64, 64, 1, 1), "heatmap_head.2": (1, 64, 1, 1)})


def efficientnet_shapes() -> Shapes:
    """The tensors of EfficientNet-Lite0's checkpoint, but for the layers behind its last block."""
    weights: Shapes = {"_conv_stem": (32, 3, 3, 3)}
    norms, names = {"_bn0": 32}, (f"_blocks.{block}" for block in itertools.count())
    blocks = ((1, 3, 16), (2, 3, 24), (2, 5, 40), (3, 3, 80), (3, 5, 112), (4, 5, 192), (1, 3, 320))
    outputs = [32, *(width for number, _, width in blocks for _ in range(number))]
    sizes = [size for number, size, _ in blocks for _ in range(number)]
    for name, (inputs, channels), size in zip(names, pairwise(outputs), sizes, strict=False):
        width = inputs
        if name != "_blocks.0":
            width = 6 * inputs
            weights[f"{name}._expand_conv"], norms[f"{name}._bn0"] = (width, inputs, 1, 1), width
        weights[f"{name}._depthwise_conv"], norms[f"{name}._bn1"] = (width, 1, size, size), width
        weights[f"{name}._project_conv"], norms[f"{name}._bn2"] = (channels, width, 1, 1), channels
    return {f"{name}.weight": shape for name, shape in weights.items()} | _norms(norms)
