"""Dense methods by OpenCV on the panoramas of a pair: semi-global block matching, dense flow, sparse features.

A point of the room keeps its azimuth, nearly, and moves down with the stroke: columns of the panoramas are epipolar
lines of an aligned rig. Block matching takes them for such, as the published methods do. Flow and features are free.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.dense.unrolled_pair import NEAREST_M, WIDTH_PX, UnrolledPair, depths_of_matches
from phibench.scenes.frames import Array

NEEDS_OPENCV = "needs OpenCV: pip install 'phibench[dense]'"
_BLOCK_PX = 5
_UNIQUENESS_PERCENT = 10
_SPECKLE_PX, _SPECKLE_STEP = 100, 2
_WRAP_PX = 32  # columns that are repeated at the seam
_RETURN_PX = 1.0  # by which flow there and back may miss
_FEATURE_CONTRAST = 0.02
_RATIO = 0.8  # D. G. Lowe, Int. J. Computer Vision 60, 91 (2004)
_ASIDE_PX = 3.0  # columns by which a feature may leave its own


def opencv() -> Any:
    """OpenCV, or one sentence.

    Raises
    ------
    DatasetError
        If it is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise DatasetError(f"this dense method {NEEDS_OPENCV}") from error
    return cv2


def codes_8bit(panorama: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Codes as OpenCV's matchers take them."""
    return np.clip(np.rint(panorama), 0.0, 255.0).astype(np.uint8)


def dense_sgbm(pair: DensePair, width_px: int = WIDTH_PX) -> DenseAnswer:
    """Semi-global block matching on panoramas, with the central model."""
    return _block_matched(pair, width_px, central=True)


def dense_sgbm_exact(pair: DensePair, width_px: int = WIDTH_PX) -> DenseAnswer:
    """Semi-global block matching on panoramas; D by the rays of the rig."""
    return _block_matched(pair, width_px, central=False)


def _block_matched(pair: DensePair, width_px: int, central: bool) -> DenseAnswer:
    unrolled = UnrolledPair.of(pair, width_px)
    disparity = block_disparity(codes_8bit(unrolled.down), codes_8bit(unrolled.up), _largest_disparity(unrolled))
    disparity[~unrolled.seen] = np.nan
    rows, columns = np.indices(disparity.shape, float)
    return unrolled.answer_of_places(rows + disparity, columns, central)


def _largest_disparity(unrolled: UnrolledPair) -> int:
    """Rows by which a point at the least D moves down, a multiple of 16: most where both directions lie evenly."""
    grid = unrolled.maps.grid
    angle = 2.0 * np.arctan(0.5 * unrolled.pair.stroke_m / NEAREST_M)
    return 16 * max(1, min(int(np.ceil(angle / grid.step_rad / 16.0)), grid.height_px // 16))


def block_disparity(down: NDArray[np.uint8], up: NDArray[np.uint8], largest_px: int) -> Array:
    """Rows by which each pixel of the down panorama lies lower in the up one, shape (H, W); NaN where unknown."""
    cv2 = opencv()
    # Epipolar lines run along rows there, and matches lie to the left: elevation grows to the right.
    left, right = (np.pad(image[::-1].T, ((0, 0), (largest_px, 0)), mode="edge") for image in (down, up))
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=largest_px,
        blockSize=_BLOCK_PX,
        P1=8 * _BLOCK_PX**2,
        P2=32 * _BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=_UNIQUENESS_PERCENT,
        speckleWindowSize=_SPECKLE_PX,
        speckleRange=_SPECKLE_STEP,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))[:, largest_px:] / 16.0
    return np.where(disparity > 0.0, disparity, np.nan).T[::-1]


def dense_flow(pair: DensePair, width_px: int = WIDTH_PX) -> DenseAnswer:
    """Dense inverse search flow between panoramas; D by the rays of the rig."""
    cv2 = opencv()
    unrolled = UnrolledPair.of(pair, width_px)
    wrap = ((0, 0), (_WRAP_PX, _WRAP_PX))
    down, up = (np.pad(codes_8bit(image), wrap, mode="wrap") for image in (unrolled.down, unrolled.up))
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = flow.calc(down, up, None), flow.calc(up, down, None)
    rows, columns = np.indices(down.shape, float)
    at = rows + there[..., 1], columns + there[..., 0]
    miss = [there[..., k] + map_coordinates(back[..., k], at, order=1, mode="nearest") for k in (0, 1)]
    known = (np.hypot(*miss) < _RETURN_PX) & (there[..., 1] > 0.0)
    inner = slice(None), slice(_WRAP_PX, -_WRAP_PX)
    known = known[inner] & unrolled.seen
    row, column = (np.where(known, place[inner], np.nan) for place in at)
    return unrolled.answer_of_places(row, column - _WRAP_PX, central=False)


def dense_sift(pair: DensePair, width_px: int = WIDTH_PX) -> DenseAnswer:
    """Sparse SIFT features of both panoramas, matched along columns; D by the rays of the rig."""
    cv2 = opencv()
    unrolled = UnrolledPair.of(pair, width_px)
    sift = cv2.SIFT_create(contrastThreshold=_FEATURE_CONTRAST)
    found = [sift.detectAndCompute(codes_8bit(image), None) for image in (unrolled.down, unrolled.up)]
    plane = np.full(pair.shape, np.nan)
    if any(descriptors is None or len(descriptors) < 2 for _, descriptors in found):
        return DenseAnswer(depth_m=plane)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(found[0][1], found[1][1], k=2)
    best = [first for first, second in pairs if first.distance < _RATIO * second.distance]
    if not best:
        return DenseAnswer(depth_m=plane)
    down = np.array([found[0][0][match.queryIdx].pt for match in best])
    up = np.array([found[1][0][match.trainIdx].pt for match in best])
    along = (np.abs(up[:, 0] - down[:, 0]) < _ASIDE_PX) & (up[:, 1] > down[:, 1])
    maps = unrolled.maps
    uv_down, uv_up = _pixels(maps.down_px, down[along]), _pixels(maps.up_far_px, up[along])
    u, v = np.rint(uv_down).astype(int).T
    inside = pair.rig.camera.contains(uv_down)
    plane[v[inside], u[inside]] = depths_of_matches(pair, uv_down, uv_up, central=False)[inside]
    return DenseAnswer(depth_m=plane)


def _pixels(map_px: Array, places: Array) -> Array:
    """Image pixels, shape (n, 2), of places (column, row) of a panorama, shape (n, 2)."""
    parts = [map_coordinates(map_px[..., k], places.T[::-1], order=1, mode="nearest") for k in (0, 1)]
    return np.stack(parts, axis=-1)
