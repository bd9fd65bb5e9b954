"""NetVLAD, Patch-NetVLAD, generalized means and SelaVPR in plain torch, with the keys of the published weights."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from experiments.benchmark.torch_networks import Weights, conv, linear, normalize, resnet

Local = tuple[np.ndarray, ...]  # descriptor of an image, then the descriptors of its patches by size

_VGG16 = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # positions of the convolutions
_POOLED = (5, 10, 17, 24)  # convolutions after a pooling


def _vgg16(w: Weights, images: Tensor) -> Tensor:
    """Maps `[B, 512, h, w]`, unit length at every position."""
    x = normalize(images)
    for position in _VGG16:
        x = F.relu(x, inplace=True) if position else x
        x = F.max_pool2d(x, 2) if position in _POOLED else x
        x = conv(w, f"encoder.{position}", x, bias=True, padding=1)
    return F.normalize(x)


def _shares(w: Weights, x: Tensor) -> Tensor:
    return F.softmax(F.conv2d(x, w("pool.conv.weight")[..., None, None]), dim=1)


def _project(w: Weights, sums: Tensor) -> Tensor:
    """Normalize sums `[N, K, D]` by cluster and together, project and normalize again -> `[N, P]`."""
    vectors = F.normalize(F.normalize(sums, dim=2).flatten(1))
    return F.normalize(F.linear(vectors, w("WPCA.0.weight"), w("WPCA.0.bias")))


def _image_descriptors(w: Weights, x: Tensor, share: Tensor) -> Tensor:
    sums = torch.einsum("bkp,bdp->bkd", share.flatten(2), x.flatten(2))
    return _project(w, sums - share.sum((2, 3))[..., None] * w("pool.centroids"))


def netvlad(w: Weights, images: Tensor) -> np.ndarray:
    """Descriptors of images."""
    x = _vgg16(w, images)
    return _image_descriptors(w, x, _shares(w, x)).cpu().numpy()


def patch_netvlad(w: Weights, images: Tensor, sizes: tuple[int, ...]) -> list[Local]:
    """Descriptors of images and of all their patches, from an integral image as published."""
    x = _vgg16(w, images)
    share = _shares(w, x)
    residuals = share[:, :, None] * (x[:, None] - w("pool.centroids")[None, :, :, None, None])
    integral = F.pad(residuals.cumsum(4).cumsum(3), (1, 0, 1, 0))
    descriptors = [_image_descriptors(w, x, share)]
    for size in sizes:
        below, above = integral[..., size:, :], integral[..., :-size, :]
        sums = below[..., size:] - below[..., :-size] - above[..., size:] + above[..., :-size]
        patches = sums.flatten(3).permute(0, 3, 1, 2)
        descriptors.append(_project(w, patches.flatten(0, 1)).unflatten(0, patches.shape[:2]))
    return list(zip(*(part.cpu().numpy() for part in descriptors), strict=True))


def gem(w: Weights, images: Tensor) -> np.ndarray:
    """Descriptors of CosPlace's ResNet-50."""
    x = resnet(w, images, "backbone.0", "backbone.1", tuple(f"backbone.{place}" for place in (4, 5, 6, 7)))
    pooled = _generalized_mean(F.normalize(x), w("aggregation.1.p"))
    return F.normalize(F.linear(pooled, w("aggregation.3.weight"), w("aggregation.3.bias"))).cpu().numpy()


def _generalized_mean(x: Tensor, power: Tensor) -> Tensor:
    return x.clamp(min=1e-6).pow(power).mean((2, 3)).pow(1 / power)


_HEAD, _PATCH, _TRAINED = 64, 14, 37  # dimensions of a head, px of a patch, patches per side in training


def selavpr(w: Weights, images: Tensor, blocks: int) -> list[Local]:
    """Descriptors of images and their local maps."""
    batch, _, height, width = images.shape
    x = conv(w, "backbone.patch_embed.proj", normalize(images), bias=True, stride=_PATCH).flatten(2).mT
    first, learned = w("backbone.pos_embed").split([1, _TRAINED**2])
    grid = learned.T.reshape(1, -1, _TRAINED, _TRAINED)
    scale = [(side // _PATCH + 0.1) / _TRAINED for side in (height, width)]
    positions = F.interpolate(grid, scale_factor=scale, mode="bicubic").flatten(2).mT
    x = torch.cat([(w("backbone.cls_token") + first).expand(batch, 1, -1), x + positions], dim=1)
    for place in range(blocks):
        x = _block(w, f"backbone.blocks.{place}", x)
    tokens = _norm(w, "backbone.norm", x)[:, 1:].mT.unflatten(2, (height // _PATCH, width // _PATCH))
    descriptors = F.normalize(_generalized_mean(F.normalize(tokens), w("aggregation.1.p")))
    local = F.relu(_upsample(w, "LocalAdapt.upconv1", tokens))
    local = F.normalize(_upsample(w, "LocalAdapt.upconv2", local)).permute(0, 2, 3, 1)
    return list(zip(descriptors.cpu().numpy(), local.cpu().numpy(), strict=True))


def _block(w: Weights, name: str, x: Tensor) -> Tensor:
    queries, keys, values = (
        part.unflatten(2, (-1, _HEAD)).transpose(1, 2)
        for part in linear(w, f"{name}.attn.qkv", _norm(w, f"{name}.norm1", x)).chunk(3, dim=2)
    )
    seen = F.scaled_dot_product_attention(queries, keys, values).transpose(1, 2).flatten(2)
    seen = linear(w, f"{name}.attn.proj", seen)
    x = x + w(f"{name}.ls1.gamma") * (seen + _adapter(w, f"{name}.adapter1", seen))
    y = _norm(w, f"{name}.norm2", x)
    hidden = F.gelu(linear(w, f"{name}.mlp.fc1", y))
    return x + w(f"{name}.ls2.gamma") * (
        linear(w, f"{name}.mlp.fc2", hidden) + 0.2 * _adapter(w, f"{name}.adapter2", y)
    )


def _adapter(w: Weights, name: str, x: Tensor) -> Tensor:
    return linear(w, f"{name}.D_fc2", F.relu(linear(w, f"{name}.D_fc1", x)))


def _norm(w: Weights, name: str, x: Tensor) -> Tensor:
    return F.layer_norm(x, x.shape[2:], w(f"{name}.weight"), w(f"{name}.bias"), 1e-6)


def _upsample(w: Weights, name: str, x: Tensor) -> Tensor:
    return F.conv_transpose2d(x, w(f"{name}.weight"), w(f"{name}.bias"), stride=2, padding=1)
