"""XFeat from its paper and published settings: float64, loops over pixels and taps, published keys, no JAX."""

import math

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
    """A map `[H, W, C]` at the pixel (x, y) of an image of `shape` (height, width); zeros outside."""
    x, y = position(pixel[0], shape[1], dense.shape[1]), position(pixel[1], shape[0], dense.shape[0])
    kernel = {"nearest": None, "bilinear": lambda distance: max(1 - abs(distance), 0), "bicubic": keys}[mode]
    total = np.zeros(dense.shape[2])
    for row, column in np.ndindex(dense.shape[:2]):
        if kernel is None:  # halves to the even number
            weight = float(row == round(y) and column == round(x))
        else:
            weight = kernel(y - row) * kernel(x - column)
        if weight:
            total += weight * dense[row, column]
    return total


def maxima(heatmap: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """(x, y) of the pixels above the threshold that no pixel of their 5 x 5 neighborhood exceeds."""
    places = []
    for row, column in np.ndindex(heatmap.shape):
        near = heatmap[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        if heatmap[row, column] > threshold and heatmap[row, column] == near.max():
            places.append((column, row))
    return places


def keypoints(heatmap: np.ndarray, reliability: np.ndarray, threshold: float) -> list[tuple[float, tuple[int, int]]]:
    """(score, (x, y)) by falling score; (0, 0) stands for padding in the public code."""
    scored = []
    for place in maxima(heatmap, threshold):
        probability = sampled(heatmap[..., None], place, heatmap.shape, "nearest")[0]
        score = probability * sampled(reliability[..., None], place, heatmap.shape, "bilinear")[0]
        if score > 0 and place != (0, 0):
            scored.append((score, place))
    return sorted(scored, key=lambda each: -each[0])


def convolved(x: np.ndarray, weight: np.ndarray, stride: int = 1) -> np.ndarray:
    """A map `[H, W, C]` and a kernel `[D, C, size, size]`, tap by tap; zeros outside."""
    size = weight.shape[-1]
    padded = np.pad(x, ((size // 2, size // 2), (size // 2, size // 2), (0, 0)))
    height, width = x.shape[0] // stride, x.shape[1] // stride
    total = np.zeros((height, width, len(weight)))
    for down, right in np.ndindex(size, size):
        taps = padded[down : down + stride * height : stride, right : right + stride * width : stride]
        total += taps[:height, :width] @ weight[:, :, down, right].T
    return total


def enlarged(x: np.ndarray, factor: int) -> np.ndarray:
    """Bilinear, by the centers of pixels; the border is repeated."""
    for axis in (0, 1):
        size = x.shape[axis]
        rows = []
        for place in range(size * factor):
            at = min(max((place + 0.5) / factor - 0.5, 0), size - 1)
            low = math.floor(at)
            rows.append((low + 1 - at) * x.take(low, axis) + (at - low) * x.take(min(low + 1, size - 1), axis))
        x = np.stack(rows, axis)
    return x


class Network:
    def __init__(self, tensors: dict[str, np.ndarray]) -> None:
        self.tensors = {key: np.asarray(value, np.float64) for key, value in tensors.items()}

    def last(self, name: str, x: np.ndarray) -> np.ndarray:
        return convolved(x, self.tensors[f"{name}.weight"]) + self.tensors[f"{name}.bias"]

    def stack(self, name: str, x: np.ndarray) -> np.ndarray:
        """All convolutions with normalization of a part."""
        for place in range(4):
            layer = f"{name}.{place}"
            if f"{layer}.layer.0.weight" in self.tensors:
                x = convolved(x, self.tensors[f"{layer}.layer.0.weight"], 2 if layer in STRIDES else 1)
                mean, variance = (self.tensors[f"{layer}.layer.1.running_{each}"] for each in ("mean", "var"))
                x = np.maximum((x - mean) / np.sqrt(variance + 1e-5), 0)
        return x

    def maps(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Descriptors of unit length, reliability and heatmap of an image `[H, W, 3]`, 0 .. 1."""
        gray = image.astype(np.float64).mean(axis=2)
        gray = (gray - gray.mean()) / np.sqrt(gray.var() + 1e-5)
        height, width = gray.shape
        pooled, cells = np.zeros((height // 4, width // 4, 1)), np.zeros((height // 8, width // 8, 64))
        for row, column in np.ndindex(pooled.shape[:2]):
            pooled[row, column] = gray[4 * row : 4 * row + 4, 4 * column : 4 * column + 4].mean()
        for row, column in np.ndindex(cells.shape[:2]):
            cells[row, column] = gray[8 * row : 8 * row + 8, 8 * column : 8 * column + 8].reshape(-1)
        fine = self.stack("block2", self.stack("block1", gray[..., None]) + self.last("skip1.1", pooled))
        coarse = self.stack("block3", fine)
        coarser = self.stack("block4", coarse)
        pyramid = coarse + enlarged(coarser, 2) + enlarged(self.stack("block5", coarser), 4)
        features = self.last("block_fusion.2", self.stack("block_fusion", pyramid))
        reliability = 1 / (1 + np.exp(-self.last("heatmap_head.2", self.stack("heatmap_head", features))[..., 0]))
        logits = np.exp(self.last("keypoint_head.3", self.stack("keypoint_head", cells)))
        heatmap = np.zeros((height, width))
        for row, column in np.ndindex(cells.shape[:2]):
            part = logits[row, column] / logits[row, column].sum()
            heatmap[8 * row : 8 * row + 8, 8 * column : 8 * column + 8] = part[:64].reshape(8, 8)
        return features / np.linalg.norm(features, axis=2, keepdims=True), reliability, heatmap


def descriptor(features: np.ndarray, pixel: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    vector = sampled(features, pixel, shape, "bicubic")
    return vector / np.linalg.norm(vector)
