"""Frames of video files."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file

VIDEO_SUFFIXES = frozenset({".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"})


def read_frames(path: Path | str, *, every: int = 1) -> Iterator[tuple[int, np.ndarray]]:
    """Read (number from 0, image `[H, W, 3]` uint8 RGB) of every `every`-th frame.

    Raises:
        InputError: no video, or a video without readable frames.
    """
    path = Path(path)
    require_file(path, "a video file")
    video, number = cv2.VideoCapture(str(path)), 0
    try:
        while video.grab():
            if number % every == 0:
                is_valid, image = video.retrieve()
                if is_valid:
                    yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            number += 1
    finally:
        video.release()
    if not number:
        raise InputError(f"{path}: expected a video, got a file without frames that can be read; convert it")
