"""Fit of a sensor from a folder of its frames: noise, tone curve, edges, JPEG, and the lens by chessboards.

Raw frames give photon transfer; processed frames give tone curve, noise and sharpening; both give blur from edges and
the lens from chessboards. Every number comes with its sigma. Numbers of the preset that the frames leave open stand in
`not_determined` with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.sensor_fit.capture_folder import (
    RAW,
    Capture,
    CaptureError,
    FrameGroup,
    JpegHeader,
    luma,
    open_capture,
    read_header,
)
from phibench.calibration.sensor_fit.edge_spread import Edge, EdgeFit, EdgeModel, edges_of, fit_edges
from phibench.calibration.sensor_fit.emva_descriptor import open_descriptor
from phibench.calibration.sensor_fit.noise_levels import ToneFit, fit_tone, stack_level
from phibench.calibration.sensor_fit.photon_transfer import TransferFit, fit_transfer
from phibench.calibration.sensor_fit.processed_noise import ProcessedNoise, fit_noise
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.frames.sensor_card import SensorCard, sensor_card
from phibench.datasets.frames.sensor_file import FitTables, MeasuredQuantity, SensorFile, allowed_numbers
from phibench.scenes.frames import Array

# Intrinsics and distortion from views of one chessboard, by OpenCV, with sigmas.


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


_NO_FLATS = "needs flat/LEVEL with two frames or more of each level"
_SCALED = "the camera shrinks these frames by an unknown filter: take frames of the sensor's own size"
_MJPEG = "MJPEG rounds noise away: take YUYV or raw frames"
_RGB_OF_YCBCR = np.array([[1.0, 0.0, 1.402], [1.0, -0.344136, -0.714136], [1.0, 1.772, 0.0]])  # BT.601


@dataclass(frozen=True)
class SensorFit:
    """Result of a fit; parts that the frames do not give are None.

    Attributes
    ----------
    capture : Capture
    file : SensorFile
    transfer : TransferFit or None
    tone : ToneFit or None
    noise : ProcessedNoise or None
    edges : EdgeFit or None
    lens : LensFit or None
    jpeg : JpegHeader or None
    """

    capture: Capture
    file: SensorFile
    transfer: TransferFit | None = None
    tone: ToneFit | None = None
    noise: ProcessedNoise | None = None
    edges: EdgeFit | None = None
    lens: LensFit | None = None
    jpeg: JpegHeader | None = None


@dataclass
class _Draft:
    """Sensor file in the making."""

    numbers: dict[str, object] = field(default_factory=dict)
    sigma: dict[str, float | list[float]] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    assumed: dict[str, str] = field(default_factory=dict)
    findings: dict[str, str] = field(default_factory=dict)
    measured: dict[str, MeasuredQuantity] = field(default_factory=dict)

    def take(self, name: str, value: object, sigma: float | tuple[float, ...] | None = None) -> None:
        self.numbers[name] = value
        if sigma is not None:
            self.sigma[name] = list(sigma) if isinstance(sigma, tuple) else sigma

    def assume(self, name: str, value: object) -> None:
        """A number that the chain needs and the frames do not tell; its reason tells what stands for it."""
        self.numbers[name] = value
        self.assumed[name] = self.missing.pop(name)

    def measure(self, name: str, value: float | list[float], sigma: float | list[float], unit: str) -> None:
        self.measured[name] = MeasuredQuantity(value=value, sigma=sigma, unit=unit)

    def file(self, capture: Capture) -> SensorFile:
        kept, refused = allowed_numbers(capture.kind, self.numbers)
        missing = dict(sorted((name, why) for name, why in (self.missing | refused).items() if name not in kept))
        assumed = {name: why for name, why in self.assumed.items() if name in kept}
        sigma = {name: value for name, value in self.sigma.items() if name in kept}
        source: dict[str, str | float | int] = {
            "frames": capture.frames,
            "format": capture.kind,
            "width_px": capture.size[1],
            "height_px": capture.size[0],
        }
        if capture.notes.camera:
            source["camera"] = capture.notes.camera
        tables = FitTables(
            findings=self.findings,
            sigma=sigma,
            assumed=assumed,
            not_determined=missing,
            measured=self.measured,
            source=source,
        )
        return SensorFile(capture.kind, kept, tables)


def fit_sensor(frames: Path) -> SensorFit:
    """Fit the frames of a folder, see `capture_folder`, or of a descriptor of EMVA 1288, see `emva_descriptor`.

    Raises
    ------
    CaptureError
        If the folder or its frames will not do; in one sentence.
    """
    capture = open_descriptor(frames) if frames.is_file() else open_capture(frames)
    draft, transfer, tone, noise, jpeg = _Draft(), None, None, None, None
    if capture.kind in RAW:
        if capture.dark or capture.flats or not (capture.edges or capture.chessboards):
            transfer = fit_transfer(capture)
            _take_transfer(draft, capture, transfer)
    else:
        tone = _take_tone(draft, capture)
        noise = _fit_noise(draft, capture, tone)
        jpeg = _take_jpeg(draft, capture)
    edges = _fit_edges(draft, capture, tone, noise)
    if noise is not None:
        if edges is not None and edges.threshold_codes is not None:
            # noise shows the blur less what the threshold takes from it
            noise = fit_noise(list(noise.levels), noise.card, capture.notes.analogue_gain, edges.threshold_codes[0])
            edges = _fit_edges(draft, capture, tone, noise)
        _take_noise(draft, capture, noise, edges)
    if edges is not None:
        _take_edges(draft, edges)
    lens = _take_lens(draft, capture)
    return SensorFit(capture, draft.file(capture), transfer, tone, noise, edges, lens, jpeg)


# -- raw frames ------------------------------------------------------------------------------------------------------


def _take_transfer(draft: _Draft, capture: Capture, found: TransferFit) -> None:
    top = (1 << capture.notes.bits) - 1
    draft.take("adc_bits", capture.notes.bits)
    for name, value in found.values.items():
        draft.take(name, value, found.sigmas[name])
    draft.missing |= found.reasons
    draft.findings |= found.findings
    for name, (quantity, sigma, unit) in found.measured.items():
        draft.measure(name, quantity, sigma, unit)
    if "full_well_e" not in found.values:
        range_dn = top - found.values["black_level_dn"]
        _take_end(draft, float(found.response.linear(np.asarray(range_dn))), capture)
    if "row_noise_e" not in found.values and "row_noise_e" not in found.reasons:
        draft.missing["row_noise_e"] = "not above the noise of these frames"
    if found.ratios:
        draft.measured["flat_red_green_blue"] = MeasuredQuantity(value=list(found.ratios))


def _take_end(draft: _Draft, codes: float, capture: Capture) -> None:
    """Full well beyond the converter's end: the chain needs a number, and there it changes nothing."""
    gain = draft.numbers["gain_dn_per_e"]
    if isinstance(gain, float):
        draft.missing["full_well_e"] += "; set beyond the last code, where it changes nothing"
        # 5 % beyond the last code
        draft.assume("full_well_e", float(round(1.05 * codes / (gain * capture.notes.analogue_gain))))


# -- processed frames ------------------------------------------------------------------------------------------------


def _take_tone(draft: _Draft, capture: Capture) -> ToneFit | None:
    tone = fit_tone(capture)
    if isinstance(tone, str):
        draft.missing["transfer_function"] = tone
        return None
    draft.take("transfer_function", tone.curve)
    if tone.points is not None:
        draft.take("transfer_points", [list(point) for point in tone.points])
    draft.measure("tone_residual", tone.rms_codes["srgb"], 0.0, "codes rms, against sRGB")
    return tone


def _fit_noise(draft: _Draft, capture: Capture, tone: ToneFit | None) -> ProcessedNoise | None:
    names = ("gain_dn_per_e", "read_noise_e", "prnu", "sharpen_amount", "white_balance", "denoise_chroma")
    if capture.kind == "mjpeg" or not capture.flats:
        draft.missing |= dict.fromkeys(names, _MJPEG if capture.kind == "mjpeg" else _NO_FLATS)
        return None
    if capture.notes.scaled:
        draft.missing |= dict.fromkeys(names, _SCALED)
        return None
    card = sensor_card(capture.kind)
    levels = []
    for group in capture.flats:
        frames = capture.stack(group)
        levels.append(stack_level(group.name, frames, _mean_rgb(frames, capture, card)))
    if not any(max(level.codes) < 254.0 for level in levels):  # 255 is cut, and 254 may be
        raise CaptureError(f"{capture.folder}: every level of flat/ is saturated; take levels from code 20 to 240")
    return fit_noise(levels, _toned(card, tone), capture.notes.analogue_gain)


def _take_noise(draft: _Draft, capture: Capture, found: ProcessedNoise, edges: EdgeFit | None) -> None:
    for name, value in found.values.items():
        plain = list(value) if isinstance(value, tuple) else value
        draft.take(name, plain, found.sigmas.get(name))
    draft.missing |= found.reasons
    if found.smoothing is not None:
        draft.take("denoise_reach_px", found.smoothing.reach_px)
        if edges is not None and edges.threshold_codes is not None:
            draft.take("denoise_threshold_codes", *edges.threshold_codes)
        elif edges is None:
            draft.missing["denoise_threshold_codes"] = "needs edge/: flat frames do not show what is spared"
    draft.missing |= {
        "dsnu_e": "the tone curve starts at black",
        "black_level_dn": "the tone curve starts at black",
        "full_well_e": "processed frames end at white",
    }
    if "gain_dn_per_e" in found.values:
        card = sensor_card(capture.kind)
        _take_end(draft, card.top_dn - card.black_level_dn, capture)
        draft.measure("noise_misfit", found.chi2, 0.0, "mean square of standardised residuals")


def _toned(card: SensorCard, tone: ToneFit | None) -> SensorCard:
    """Card with the measured tone curve."""
    if tone is None:
        return card
    return replace(card, transfer_function=tone.curve, transfer_points=tone.points)


def _mean_rgb(frames: Array, capture: Capture, card: SensorCard) -> tuple[float, float, float]:
    """Mean R, G, B on 0 to 255."""
    if capture.kind != "yuyv":
        red, green, blue = (float(x) for x in frames.reshape(-1, 3).mean(axis=0))
        return red, green, blue
    black, y_codes, c_codes = (0.0, 255.0, 255.0) if card.ycbcr_range == "full" else (16.0, 219.0, 224.0)
    y = 255.0 * (float(frames[..., 0].mean()) - black) / y_codes
    cb, cr = (255.0 * (float(frames[..., k::2, 1].mean()) - 128.0) / c_codes for k in (0, 1))
    red, green, blue = (float(x) for x in _RGB_OF_YCBCR @ np.array([y, cb, cr]))
    return red, green, blue


def _take_jpeg(draft: _Draft, capture: Capture) -> JpegHeader | None:
    if capture.kind != "mjpeg":
        return None
    files = [path for group in _every_group(capture) for path in group.files]
    header, *others = (_header(path) for path in files)
    if differing := [path for path, other in zip(files[1:], others, strict=True) if other.tables != header.tables]:
        raise CaptureError(
            f"{differing[0]} has other quantisation tables than {files[0]}: two cameras, or a quality that changed; "
            "give frames of one camera with one quality"
        )
    if header.quality is not None:
        draft.take("jpeg_quality", header.quality)
    else:
        draft.take("jpeg_qtables", [list(table) for table in header.tables])
    draft.take("jpeg_subsampling", header.subsampling)
    if header.restart_interval:
        draft.take("jpeg_restart_interval", header.restart_interval)
    return header


def _header(path: Path) -> JpegHeader:
    return read_header(InputFile(path, "give the camera's own picture", CaptureError).read(), str(path))


def _every_group(capture: Capture) -> list[FrameGroup]:
    single = [g for g in (capture.dark, capture.edges, capture.chessboards) if g is not None]
    return [*single, *capture.flats, *capture.exposures, *capture.dark_exposures]


# -- edges and lens --------------------------------------------------------------------------------------------------


def _fit_edges(draft: _Draft, capture: Capture, tone: ToneFit | None, noise: ProcessedNoise | None) -> EdgeFit | None:
    groups = [g for g in (capture.edges, capture.chessboards) if g is not None]
    if not groups:
        draft.missing["edge_sigma_px"] = "needs edge/ or chessboard/: straight edges, 2 to 30 degrees from rows"
        return None
    if capture.kind in RAW:
        draft.missing["edge_sigma_px"] = "edges are measured on processed frames"
        return None
    edges = [edge for group in groups for path in group.files for edge in _edges(capture, path)]
    curve, points = (tone.curve, tone.points) if tone is not None else ("srgb", None)
    model = EdgeModel(curve, points, "mean" if capture.notes.scaled else "placed")
    if noise is not None and noise.smoothing is not None and noise.numbers is not None:
        fit = fit_edges(edges, replace(model, smoothing=noise.smoothing), max(noise.numbers.sharpen, 0.0))
        if not isinstance(fit, str) and fit.threshold_codes is not None:
            return fit
    fit = fit_edges(edges, model)
    if isinstance(fit, str):
        draft.missing["edge_sigma_px"] = fit
        return None
    return fit


def _take_edges(draft: _Draft, found: EdgeFit) -> None:
    draft.measure("edge_sigma_px", found.sigma_px, found.sigma_sigma_px, "px")
    draft.measure("edge_sharpen_amount", found.sharpness, found.sharpness_sigma, "1")
    for name, value in vars(found.measure).items():
        unit = "px" if name.endswith("_px") else "1"
        draft.measure(f"edge_{name}", value, getattr(found.measure_sigma, name), unit)
    if "sharpen_amount" not in draft.numbers and "denoise_luma" not in draft.numbers:
        name = "sharpen_amount" if found.sharpness >= 0.0 else "denoise_luma"
        draft.take(name, abs(found.sharpness), found.sharpness_sigma)
        draft.missing.pop("sharpen_amount", None)


def _edges(capture: Capture, path: Path) -> list[Edge]:
    return list(edges_of(luma(capture.read(path), capture.kind)))


def _take_lens(draft: _Draft, capture: Capture) -> LensFit | None:
    lens = fit_lens(capture)
    if isinstance(lens, str):
        draft.missing["lens"] = lens
        return None
    for name, value in lens.values.items():
        draft.measure(name, value, lens.sigmas[name], "px" if name.endswith("_px") else "1")
    draft.measure("corner_residual_px", lens.rms_px, lens.rms_px / np.sqrt(2.0 * lens.views), "px")
    return lens
