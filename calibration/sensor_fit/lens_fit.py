"""Intrinsics and distortion from views of one chessboard, by OpenCV, with sigmas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.sensor_fit.capture_folder import RAW, Capture, CaptureError, luma
from phibench.scenes.frames import Array

_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
_LEAST_VIEWS = 4
_TIMES_RMS = 3.0  # a view whose corners fit so much worse than the median was found wrongly


@dataclass(frozen=True)
class LensFit:
    """Pinhole camera with Brown's distortion, as OpenCV has them; pixels have integers at their centres.

    Attributes
    ----------
    values, sigmas : by name: fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3
    rms_px : of the corners' residuals, per coordinate
    views, given : number of views used, and of those given
    corners : per used view, shape (n, 2), pixels
    """

    values: dict[str, float]
    sigmas: dict[str, float]
    rms_px: float
    views: int
    given: int
    corners: tuple[Array, ...]


def fit_lens(capture: Capture) -> LensFit | str:
    """Fit the chessboards of a capture, or say why these frames do not tell.

    Raises
    ------
    CaptureError
        If there are chessboards, and OpenCV is not installed or the notes do not name the board.
    """
    if capture.chessboards is None:
        return "needs chessboard/: ten views or more of one chessboard"
    cv2 = _opencv()
    board = (capture.notes.board_columns, capture.notes.board_rows)
    if board[0] is None or board[1] is None:
        raise CaptureError(
            f"{capture.folder / 'chessboard'}: write board_columns and board_rows, the board's inner corners, into "
            "capture.toml"
        )
    size = (board[0], board[1])
    images = [_grey(capture.read(path), capture) for path in capture.chessboards.files]
    views = [corners for image in images if (corners := find_corners(image, size)) is not None]
    if len(views) < _LEAST_VIEWS:
        return f"{len(views)} of {len(images)} views show all {size[0]} x {size[1]} corners: {_LEAST_VIEWS} are needed"
    square = capture.notes.board_square_m or 1.0
    grid = np.zeros((size[0] * size[1], 3), np.float32)
    grid[:, :2] = square * np.mgrid[0 : size[0], 0 : size[1]].T.reshape(-1, 2)
    height, width = capture.size
    kept = views
    for _ in range(2):  # the second time without views that were found wrongly
        rms, matrix, distortion, _, _, deviations, _, per_view = cv2.calibrateCameraExtended(
            [grid] * len(kept), [c.astype(np.float32)[:, None] for c in kept], (width, height), None, None
        )
        limit = _TIMES_RMS * float(np.median(per_view))
        better = [c for c, error in zip(kept, per_view.ravel(), strict=True) if error <= limit]
        if len(better) == len(kept) or len(better) < _LEAST_VIEWS:
            break
        kept = better
    numbers = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5])
    values = {name: float(x) for name, x in zip(_NAMES, numbers, strict=True)}
    sigmas = {name: float(x) for name, x in zip(_NAMES, deviations.ravel()[: len(_NAMES)], strict=True)}
    return LensFit(values, sigmas, float(rms) / np.sqrt(2.0), len(kept), len(images), tuple(kept))


def find_corners(image: NDArray[np.uint8], size: tuple[int, int]) -> Array | None:
    """Inner corners, shape (columns x rows, 2), pixels; None if they are not all seen."""
    cv2 = _opencv()
    found, corners = cv2.findChessboardCorners(image, size)
    if not found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria), float).reshape(-1, 2)


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise CaptureError(
            "chessboards need OpenCV: pip install 'phibench[lens]', or take chessboard/ out of the folder"
        ) from error
    return cv2


def _grey(image: NDArray[Any], capture: Capture) -> NDArray[np.uint8]:
    if capture.kind in RAW:
        # (1 2 1)/4 along both axes makes a mosaic grey and moves nothing
        values = image.astype(float)
        padded = np.pad(values, 1, mode="reflect")
        values = sum(  # type: ignore[assignment]
            w * padded[i : i + values.shape[0], j : j + values.shape[1]]
            for i, j, w in ((a, b, (1, 2, 1)[a] * (1, 2, 1)[b] / 16.0) for a in range(3) for b in range(3))
        )
        low, high = np.percentile(values, (0.5, 99.5))
        return np.clip(255.0 * (values - low) / max(high - low, 1.0), 0.0, 255.0).astype(np.uint8)
    return np.clip(np.rint(luma(image, capture.kind)), 0.0, 255.0).astype(np.uint8)
