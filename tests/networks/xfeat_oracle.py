"""XFeat from its paper and published settings: float64, published keys, no JAX."""

import numpy as np

STRIDES = {"block1.1", "block1.3", "block3.0", "block4.0", "block5.0"}  # convolutions of stride 2


def position(pixel: int, size: int, cells: int) -> float:
    """A pixel of `size` on a map: -1 .. 1 from the first to the last pixel, which are corners of the map."""
    return ((2 * pixel / (size - 1) - 1 + 1) * cells - 1) / 2


def keys(distance: float) -> float:
    """The cubic kernel of Keys (1981) with a = -0.75."""
    a, x = -0.75, abs(distance)
    if x <= 1:
        return (a + 2) * x**3 - (a + 3) * x**2 + 1
    return a * x**3 - 5 * a * x**2 + 8 * a * x - 4 * a if x < 2 else 0.0


def sampled(dense: np.ndarray, pixel: tuple[int, int], shape: tuple[int, int], mode: str) -> np.ndarray:
    """A map `[H, W, C]` at (x, y) px of an image of `shape` (height, width); zeros outside; unit length if bicubic."""
    x, y = position(pixel[0], shape[1], dense.shape[1]), position(pixel[1], shape[0], dense.shape[0])
    if mode == "nearest":  # halves to the even number
        x, y = round(x), round(y)
    kernel = keys if mode == "bicubic" else lambda distance: max(1 - abs(distance), 0)
    rows, columns = ([kernel(at - cell) for cell in range(side)] for at, side in ((y, len(dense)), (x, dense.shape[1])))
    values = np.einsum("r,c,rcd->d", rows, columns, dense)
    return values / np.linalg.norm(values) if mode == "bicubic" else values


def keypoints(heatmap: np.ndarray, reliability: np.ndarray, threshold: float) -> list[tuple[float, tuple[int, int]]]:
    """(score, (x, y)) by falling score; (0, 0) stands for padding in the public code."""
    scored = []
    for y, x in np.ndindex(heatmap.shape):
        if heatmap[y, x] > threshold and heatmap[y, x] == heatmap[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].max():
            score = sampled(heatmap[..., None], (x, y), heatmap.shape, "nearest")[0]
            score *= sampled(reliability[..., None], (x, y), heatmap.shape, "bilinear")[0]
            scored += [(score, (x, y))] if score > 0 and (x, y) != (0, 0) else []
    return sorted(scored, key=lambda each: -each[0])


def convolved(x: np.ndarray, weight: np.ndarray, stride: int = 1) -> np.ndarray:
    """A map `[H, W, C]` and a kernel `[D, C, size, size]`, tap by tap; zeros outside."""
    margin, (height, width) = weight.shape[-1] // 2, x.shape[:2]
    x, taps = np.pad(x, ((margin, margin), (margin, margin), (0, 0))), np.ndindex(weight.shape[2:])
    return sum(x[i : i + height : stride, j : j + width : stride] @ weight[:, :, i, j].T for i, j in taps)


def enlarged(x: np.ndarray, factor: int) -> np.ndarray:
    """Bilinear, by the centers of pixels; the border is repeated."""
    for axis in (0, 1):
        centers = (np.arange(factor * x.shape[axis]) + 0.5) / factor - 0.5
        line = lambda values, at=centers: np.interp(at, np.arange(len(values)), values)  # noqa: E731
        x = np.apply_along_axis(line, axis, x)
    return x


def maps(image: np.ndarray, tensors: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Descriptors of unit length, reliability and heatmap of an image `[H, W, 3]`, 0 .. 1, with published tensors."""

    def last(name: str, x: np.ndarray) -> np.ndarray:
        return convolved(x, tensors[f"{name}.weight"]) + tensors[f"{name}.bias"]

    def stack(name: str, x: np.ndarray) -> np.ndarray:
        for layer in (f"{name}.{place}" for place in range(4)):
            if f"{layer}.layer.0.weight" in tensors:  # has a normalization
                x = convolved(x, tensors[f"{layer}.layer.0.weight"], 2 if layer in STRIDES else 1)
                mean, variance = (tensors[f"{layer}.layer.1.running_{each}"] for each in ("mean", "var"))
                x = np.maximum((x - mean) / np.sqrt(variance + 1e-5), 0)
        return x

    gray = image.mean(axis=2)
    gray = (gray - gray.mean()) / np.sqrt(gray.var() + 1e-5)
    pooled = sum(gray[i::4, j::4, None] for i, j in np.ndindex(4, 4)) / 16
    coarse = stack("block3", stack("block2", stack("block1", gray[..., None]) + last("skip1.1", pooled)))
    coarser = stack("block4", coarse)
    pyramid = coarse + enlarged(coarser, 2) + enlarged(stack("block5", coarser), 4)
    features = last("block_fusion.2", stack("block_fusion", pyramid))
    reliability = 1 / (1 + np.exp(-last("heatmap_head.2", stack("heatmap_head", features))[..., 0]))
    cells = np.stack([gray[i::8, j::8] for i, j in np.ndindex(8, 8)], axis=2)
    logits = np.exp(last("keypoint_head.3", stack("keypoint_head", cells)))
    heatmap = np.zeros(gray.shape)
    for place, (i, j) in enumerate(np.ndindex(8, 8)):
        heatmap[i::8, j::8] = logits[..., place] / logits.sum(axis=2)
    return features / np.linalg.norm(features, axis=2, keepdims=True), reliability, heatmap
