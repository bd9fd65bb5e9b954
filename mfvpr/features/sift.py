"""OpenCV SIFT as RootSIFT (Lowe, IJCV 2004; Arandjelovic & Zisserman, CVPR 2012): local features without a download."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.utils.fields import POSITIVE, SHAPED_SIZE, SIZE, check_fields, setting, whole, word_of


@dataclass(frozen=True)
class Sift:
    """RootSIFT of the gray image, 128 dimensions; scores are the detector's responses (of order 0.01 to 0.2).

    The `max_keypoints` (None = all) of the highest scores are kept. `contrast_threshold` is OpenCV's.
    """

    vector_size = 0  # no global descriptor
    image_size: tuple[int, int] = setting((336, 336), SIZE, SHAPED_SIZE)
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    max_keypoints: int | None = setting(800, whole(1, 20_000) | None, "the highest scores are kept; null = all")
    contrast_threshold: float = setting(0.01, POSITIVE, "low: the strongest max_keypoints are kept, in dark images too")
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    __post_init__ = check_fields

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale of 128 dimensions; textured images reach `max_keypoints`, or one keypoint in 100 px."""
        return (Scale(128, self.max_keypoints or self.image_size[0] * self.image_size[1] // 100),)

    def __call__(self, images: UInt8[np.ndarray, "images height width 3"]) -> list[Description]:
        detector = cv2.SIFT_create(self.max_keypoints or 0, contrastThreshold=self.contrast_threshold)  # pyright: ignore
        descriptions = []
        for image in images:
            gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            detections, descriptors = detector.detectAndCompute(gray, None)
            scores = np.array([keypoint.response for keypoint in detections], np.float32)
            strongest = np.argsort(-scores, kind="stable")[: self.max_keypoints]  # OpenCV keeps ties beyond the limit
            keypoints = np.array([keypoint.pt for keypoint in detections], np.float32).reshape(-1, 2)
            sift = np.zeros((0, 128), np.float32) if descriptors is None else descriptors[strongest]
            # RootSIFT: the square root of L1-normalized SIFT has unit Euclidean length.
            root = np.sqrt(sift / np.maximum(sift.sum(axis=1, keepdims=True), 1e-12))
            features = local_features(keypoints[strongest], root, gray.shape[::-1], scores[strongest])
            descriptions.append(Description(local=(features,)))
        return descriptions
