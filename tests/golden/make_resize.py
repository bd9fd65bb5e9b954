"""Makes resize.npz: what torch's resampling gives. `python -m tests.golden resize`"""

import numpy as np

SIZE = (16, 12)  # width, height


def image() -> np.ndarray:
    """`[30, 40, 3]` uint8: noise, by integer arithmetic alone."""
    row, column, channel = np.indices((30, 40, 3))
    return ((row * 7919 + column * 104729 + channel * 1299709) ** 2 // 1009 % 256).astype(np.uint8)


def main() -> dict[str, np.ndarray]:
    import torch
    from torch.nn.functional import interpolate

    batch = torch.from_numpy(image()).permute(2, 0, 1)[None]
    bicubic = interpolate(batch, SIZE[::-1], mode="bicubic", antialias=True)
    bilinear = interpolate(batch.float(), SIZE[::-1], mode="bilinear", antialias=True)
    plain = interpolate(batch.float(), SIZE[::-1], mode="bilinear", antialias=False)
    golden = {"pil_bicubic": bicubic, "torch_bilinear": bilinear, "torch_no_antialias": plain}
    return {name: result[0].permute(1, 2, 0).numpy() for name, result in golden.items()}
