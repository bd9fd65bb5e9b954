"""Networks as Flax NNX modules: arrays in, arrays out.

Images are `[B, H, W, 3]` float32. Products have full float32 precision: with less, keypoints move.

Read first: d2net or global_descriptors, then the shared parts: backbones, vit, layers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
