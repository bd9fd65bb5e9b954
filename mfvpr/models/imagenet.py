"""Statistics of ImageNet's training images, RGB in 0 .. 1: what networks trained on them, or from them, subtract."""

MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
