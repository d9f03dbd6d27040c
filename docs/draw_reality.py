"""Real frames of a C310 beside simulated ones, through the same measures: the tables and the picture of `reality.md`.

    git clone https://github.com/bimalka98/Camera-Calibration-and-Backprojection c310
    python docs/draw_reality.py c310/images-static_camera --every 3

Give a folder of that repository (MIT licence); branch `M-CAIT-2013` has another, `raw_images`. No frame is copied. The
simulated frames are those of preset `yuyv`, decoded and saved once more at quality 95, 4:2:0, as the real ones were.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.fft import dctn
from scipy.special import ndtr

from phibench.estimator.sensor_fit.edge_spread import Edge, EdgeModel, edges_of, fit_edges, measure
from phibench.estimator.sensor_fit.fit import fit_sensor
from phibench.estimator.sensor_fit.lens_fit import LensFit
from phibench.estimator.sensor_fit.processed_noise import LAGS, patch_levels
from phibench.estimator.sensor_fit.tone_curve import decoded_by
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.light import Light
from phibench.render.sensor.noise_tiles import NoiseStream
from phibench.render.sensor.processing import rgb_from_yuyv
from phibench.render.sensor.settings import Sensor, sensor

Array = NDArray[Any]
PICTURE = Path(__file__).with_name("reality.png")
DARK, BRIGHT = (12.0, 40.0), (185.0, 225.0)  # codes of the two levels at which the boards have hardly any texture
QUIET = 0.3  # of the patches, those with the least variance: others have texture
PATCH, STRIDE = 16, 8
SAMPLE_PX = (480, 640)
CODES = (30.0, 205.0)  # of the simulated board
STEPS = range(5, 41)


@dataclass(frozen=True)
class Column:
    """Measures of one set of frames: name to mean and standard error over the frames."""

    title: str
    values: dict[str, tuple[float, float]]
    profile: tuple[Array, Array]
    edges: tuple[Edge, ...]


def ycbcr(source: Any) -> Array:
    """Y', Cb, Cr of a JPEG, shape (h, w, 3), as they are in the file."""
    with Image.open(source) as picture:
        picture.draft("YCbCr", picture.size)
        return np.asarray(picture.convert("YCbCr")).astype(float)


def sent(path: Path) -> Array:
    """The frame as it would be if the camera had sent it as JPEG of quality 76: a control for `comb`."""
    first, second = io.BytesIO(), io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").save(first, "JPEG", quality=76, subsampling="4:2:2")
    with Image.open(first) as picture:
        picture.convert("RGB").save(second, "JPEG", quality=95, subsampling="4:2:0")
    return ycbcr(second)


# -- measures of one frame -------------------------------------------------------------------------------------------


def measures(frame: Array, found_edges: Sequence[Edge]) -> dict[str, float]:
    """All measures of one frame with its edges; those that it does not tell are NaN."""
    luma = frame[..., 0]
    found: dict[str, float] = {}
    edges = [measure(edge) for edge in found_edges]
    for name in ("rise_px", "overshoot", "undershoot"):
        values = [getattr(edge, name) for edge in edges]
        found[f"edge {name}"] = float(np.median(values)) if len(values) >= 5 else np.nan
    for name, (low, high) in (("dark", DARK), ("bright", BRIGHT)):
        patches = list(quiet(luma, low, high))
        covariance = patch_levels(name, patches, (low,) * 3).covariance[0] if len(patches) >= 8 else np.full(7, np.nan)
        found[f"noise {name}, codes rms"] = float(np.sqrt(covariance[0]))
        for lag, label in (((0, 1), "beside"), ((1, 0), "below"), ((1, 1), "diagonal"), ((0, 2), "two beside")):
            found[f"correlation {name}, {label}"] = float(covariance[LAGS.index(lag)] / covariance[0])
    found["2 x 2 signature, largest / mean variance"] = signature(luma)
    found["chroma noise, correlation two beside"] = chroma(frame[..., 1], luma)
    return found


def quiet(image: Array, low: float, high: float, of: Array | None = None) -> Iterator[Array]:
    """Patches of a level, of these the share `QUIET` with the least variance; of another plane if `of` is given."""
    chosen = []
    for top in range(STRIDE, image.shape[0] - PATCH - STRIDE, STRIDE):
        for left in range(STRIDE, image.shape[1] - PATCH - STRIDE, STRIDE):
            part = (slice(top, top + PATCH), slice(left, left + PATCH))
            patch = image[part]
            if low <= patch.mean() < high and np.ptp(patch) < 24.0:
                chosen.append((float(patch.var()), part))
    chosen.sort(key=lambda item: item[0])
    for _, part in chosen[: int(QUIET * len(chosen))]:
        yield (image if of is None else of)[part]


def signature(luma: Array) -> float:
    """Largest of the four places' variances of what is rough, over their mean: 1 without traces of a mosaic."""
    totals = np.zeros((2, 2))
    for patch in quiet(luma, *BRIGHT):
        rough = patch[1:-1, 1:-1] - 0.25 * (patch[:-2, 1:-1] + patch[2:, 1:-1] + patch[1:-1, :-2] + patch[1:-1, 2:])
        totals += [[rough[i::2, j::2].var() for j in (0, 1)] for i in (0, 1)]
    return float(totals.max() / totals.mean()) if totals.any() else np.nan


def chroma(cb: Array, luma: Array) -> float:
    """Correlation of Cb two pixels apart along rows, in bright patches."""
    patches = list(quiet(luma, *BRIGHT, of=cb))
    if len(patches) < 8:
        return np.nan
    covariance = patch_levels("cb", patches, (128.0,) * 3).covariance[0]
    return float(covariance[LAGS.index((0, 2))] / covariance[0]) if covariance[0] > 0.0 else np.nan


def comb(luma: Array) -> float:
    """Share of DCT coefficients near multiples of the best step, over what chance gives: an earlier JPEG has a comb."""
    h, w = (side // 8 * 8 for side in luma.shape)
    blocks = luma[:h, :w].reshape(h // 8, 8, w // 8, 8).transpose(0, 2, 1, 3) - 128.0
    coefficients = dctn(blocks, axes=(2, 3), norm="ortho")
    best = 0.0
    for place in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        values = coefficients[:, :, place[0], place[1]].ravel()
        values = values[np.abs(values) > 2.5]
        for step in STEPS:
            near = np.abs(values / step - np.rint(values / step)) * step < 1.0
            if len(values) > 300:
                best = max(best, float(near.mean()) * step / 2.0)
    return best


def column(title: str, frames: Sequence[Array], with_edges: bool = True) -> Column:
    """Means over the frames with their standard errors."""
    of_frames = [list(edges_of(frame[..., 0])) if with_edges else [] for frame in frames]
    each = [measures(frame, edges) for frame, edges in zip(frames, of_frames, strict=True)]
    values = {}
    for name in each[0]:
        known = np.array([one[name] for one in each])
        known = known[np.isfinite(known)]
        error = float(known.std(ddof=1) / np.sqrt(len(known))) if len(known) > 1 else np.nan
        values[name] = (float(known.mean()) if len(known) else np.nan, error)
    edges = [edge for some in of_frames for edge in some]
    at = np.arange(-6.5, 6.5, 0.25)
    curve = np.mean([np.interp(at, *edge.profile()) for edge in edges], axis=0) if edges else np.full(len(at), np.nan)
    return Column(title, values, (at, curve), tuple(edges))


# -- simulated frames ------------------------------------------------------------------------------------------------


def simulated(s: Sensor, sigma_px: float, count: int, seed: int) -> list[Array]:
    """Frames of a board, turned a little more in each, as YUYV, saved once more at quality 95, 4:2:0."""
    white_e = (s.top_dn - s.black_level_dn) / s.dn_per_e
    balance = np.array(s.white_balance)[:, None, None]
    frames = []
    for k in range(count):
        light = Light(board(4.0 + 2.0 * k, sigma_px)[None] / balance * white_e / s.exposure_s)
        picture = rgb_from_yuyv(Chain(s, seed).frame(light, NoiseStream(("reality", seed, k))), s)
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=95, subsampling="4:2:0")
        frames.append(ycbcr(file))
    return frames


def board(angle_deg: float, sigma_px: float) -> Array:
    """Linear light of a blurred chessboard with fields of 40 pixels."""
    y, x = np.mgrid[0.0 : SAMPLE_PX[0], 0.0 : SAMPLE_PX[1]]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))

    def stripes(t: Array) -> Array:
        t = np.mod(t, 80.0)
        return np.asarray(ndtr((t - 20.0) / sigma_px) - ndtr((t - 60.0) / sigma_px))

    u, v = stripes(c * x + s * y), stripes(-s * x + c * y)
    dark, bright = decoded_by("srgb", np.array(CODES))
    return np.asarray(dark + (bright - dark) * (u * (1.0 - v) + v * (1.0 - u)))


def fit_noise_first(real: Column, count: int) -> tuple[Sensor, float]:
    """Sensor whose bright noise has the real level and correlation; blur as small as the chain needs."""
    target = real.values["noise bright, codes rms"][0], real.values["correlation bright, beside"][0]
    denoise, well = 0.5, 12000.0
    for step in range(6):
        found = column("", simulated(_sensor(well, denoise_luma=denoise), 0.3, count, 10 + step), False).values
        well *= (found["noise bright, codes rms"][0] / target[0]) ** 2
        well = float(np.clip(well, 500.0, 60000.0))
        denoise = float(np.clip(denoise + 1.5 * (target[1] - found["correlation bright, beside"][0]), 0.0, 1.0))
    return _sensor(well, denoise_luma=denoise), 0.3


def fit_edges_first(real: Column, count: int) -> tuple[Sensor, float]:
    """Sensor whose edges have the real spread; gain from the level of the noise."""
    found = fit_edges(list(real.edges), EdgeModel("srgb", None, "mean"))
    if isinstance(found, str):
        raise SystemExit(f"draw_reality: {found}")
    sharpen, sigma, well = max(found.sharpness, 0.0), found.sigma_px, 12000.0
    for step in range(4):
        here = column("", simulated(_sensor(well, sharpen_amount=sharpen), sigma, count, 20 + step)).values
        well *= (here["noise bright, codes rms"][0] / real.values["noise bright, codes rms"][0]) ** 2
        well = float(np.clip(well, 500.0, 90000.0))
        ratio = real.values["edge rise_px"][0] / here["edge rise_px"][0]
        if np.isfinite(ratio):
            sigma = float(np.clip(sigma * ratio, 0.15, 2.0))
    return _sensor(well, sharpen_amount=sharpen), sigma


def _sensor(full_scale_e: float, **changes: float) -> Sensor:
    return sensor("yuyv", full_well_e=1.1 * full_scale_e, gain_dn_per_e=959.0 / full_scale_e, **changes)


# -- page ------------------------------------------------------------------------------------------------------------


def table(columns: Sequence[Column]) -> str:
    """Markdown: mean and 95 % interval of each measure."""
    lines = ["| measure | " + " | ".join(one.title for one in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name in columns[0].values:
        cells = [f"{mean:.3f} +- {1.96 * error:.3f}" for mean, error in (one.values[name] for one in columns)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def lens(paths: Sequence[Path]) -> LensFit | None:
    """Intrinsics and distortion of the boards: 9 x 7 inner corners, 30 mm."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "chessboard"
        folder.mkdir()
        for k, path in enumerate(paths):
            (folder / f"{k:03d}.jpg").symlink_to(path.resolve())
        notes = "board_columns = 9\nboard_rows = 7\nboard_square_m = 0.03\nscaled = true\n"
        (Path(place) / "capture.toml").write_text(notes)
        return fit_sensor(Path(place)).lens


def draw(columns: Sequence[Column]) -> None:
    """Edge spread functions."""
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    for one, style in zip(columns, ("k-", "C0--", "C1-", "C2-"), strict=False):
        axes.plot(*one.profile, style, label=one.title)
    axes.set(xlabel="distance from the edge, px", ylabel="share of the step", xlim=(-5, 5))
    axes.legend()
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--frames", type=int, default=6, help="simulated frames of a column")
    parser.add_argument("--lens", action="store_true")
    options = parser.parse_args()
    paths = sorted(options.folder.glob("*.jpg"))[:: options.every]
    frames = [ycbcr(path) for path in paths]
    real = column("real", frames)
    columns = [real, column("preset", simulated(sensor("yuyv"), 0.7, options.frames, 1))]
    for title, (s, sigma) in (
        ("fitted to noise", fit_noise_first(real, 3)),
        ("fitted to edges", fit_edges_first(real, 3)),
    ):
        print(
            f"{title}: full scale {959.0 / s.gain_dn_per_e:.0f} e-, denoise_luma {s.denoise_luma:.2f}, "
            f"sharpen_amount {s.sharpen_amount:.2f}, optical blur {sigma:.2f} px"
        )
        columns.append(column(title, simulated(s, sigma, options.frames, 2)))
    combs = [[comb(f[..., 0]) for f in some] for some in (frames, [sent(path) for path in paths])]
    print(
        f"DCT comb: real {np.mean(combs[0]):.2f} (largest {max(combs[0]):.2f}); the same frames after a JPEG of "
        f"quality 76 {np.mean(combs[1]):.2f} (least {min(combs[1]):.2f})"
    )
    print(f"\n{len(frames)} real frames, {options.frames} simulated ones per column\n\n{table(columns)}")
    draw(columns)
    if options.lens and (found := lens(sorted(options.folder.glob("*.jpg")))) is not None:
        print(f"\nlens, {found.views} of {found.given} views, corners {found.rms_px:.2f} px rms")
        for name, value in found.values.items():
            print(f"| {name} | {value:.5g} | {found.sigmas[name]:.2g} |")


if __name__ == "__main__":
    main()
