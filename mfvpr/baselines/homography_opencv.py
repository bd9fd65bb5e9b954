"""OpenCV's findHomography as a score, the paper's SSM-RAN: pair by pair on the processor's threads, as a reference."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.scorer import check_bounds
from mfvpr.core.types import Array, Matches, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import POSITIVE, check_fields, number, one_of, setting
from mfvpr.utils.numerics import available_cpus, is_concrete


@value
class OpenCvHomography:
    """s = number of inliers of cv2.findHomography, from the candidate's points to the query's.

        mfvpr.score_candidates(mfvpr.OpenCvHomography(), candidate_matches)  # [C]

    The score runs on the host: all functions of the library accept it, but `jit`, `vmap` and gradients do not. (JAX's
    callbacks may deadlock.) OpenCV's samples depend on the order of the matches, so that matches are sorted by
    `index0`, or by their coordinates without it. A match of confidence 0 is ignored, all others count fully. OpenCV 4
    counts the inliers before its last least squares, version 5 after it.

    Attributes:
        threshold: largest error of an inlier, px of the query; 8 and 24 in the paper.
        max_iterations: maximum number of samples; rounded to an integer.
        confidence: RANSAC stops once a sample of inliers only was drawn with this probability.
        estimator: `ransac`, the paper's, or `magsac` (USAC_MAGSAC; Barath et al., CVPR 2020).
        few: score of less than 4 matches, `count` (re-ranking-for-VPR) or `zero` (Patch-NetVLAD).
    """

    threshold: float | Array = setting(24.0, POSITIVE, unit="px")
    max_iterations: float | Array = setting(2000.0, number(1.0, 1000000.0), "at most", unit="samples")
    confidence: float | Array = setting(0.995, number(1e-06, 0.999999), "that a sample was all inliers")
    estimator: str = setting("ransac", one_of("ransac", "magsac"), static=True)
    few: str = setting("count", one_of("count", "zero"), "less than 4 matches", static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[np.ndarray, ""]:
        """Score of one pair `[K]`, float32; an `InputError` if anything is traced, or a number is out of bounds."""
        if not is_concrete((self, matches)):
            raise InputError(
                "homography_opencv: expected matches that neither jit nor vmap nor grad traces, since "
                "OpenCV runs outside of JAX; call score_candidates, or take Homography"
            )
        check_bounds(self)  # OpenCV replaces a threshold of 0 by 3 px
        points = np.concatenate([matches.points1, matches.points0], axis=-1, dtype=np.float32, casting="unsafe")
        real = np.asarray(matches.mask)
        if matches.confidence is not None:
            if np.isnan(np.asarray(matches.confidence)[real]).any():
                return np.array(np.nan, np.float32)
            real = real & (np.asarray(matches.confidence) > 0)
        points = points[real]
        keys = points.T[::-1] if matches.index0 is None else [np.asarray(matches.index0)[real]]
        return np.array(self._score(points[np.lexsort([*keys])]), np.float32)

    def score_pairs(self, matches: Matches) -> Float[np.ndarray, " pairs"]:
        """Scores of pairs `[P, K, ...]`, float32."""
        host, count = jax.tree.map(np.asarray, matches), len(matches.mask)
        pairs = (jax.tree.map(lambda leaf, pair=pair: leaf[pair], host) for pair in range(count))
        with ThreadPoolExecutor(available_cpus()) as pool:  # OpenCV releases Python's lock
            return np.fromiter(pool.map(self, pairs), np.float32, count)

    def _score(self, points: Float[np.ndarray, "slots 4"]) -> float:
        """Score of real matches (x1, y1, x0, y0)."""
        import cv2  # here, because it slows down the import of the library

        if not np.isfinite(points).all():
            return np.nan
        if len(points) < 4:
            return len(points) if self.few == "count" else 0
        estimator = {"ransac": cv2.RANSAC, "magsac": cv2.USAC_MAGSAC}[self.estimator]
        _, inliers = cv2.findHomography(
            points[:, :2],
            points[:, 2:],
            estimator,
            float(self.threshold),
            maxIters=round(float(self.max_iterations)),
            confidence=float(self.confidence),
        )
        return 0 if inliers is None else inliers.sum()
