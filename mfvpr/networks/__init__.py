"""Networks as Flax NNX modules, one file each: arrays in, arrays out; images are NHWC float32."""
