"""Real frames of a C310 beside simulated ones, through the same measures: the tables and the picture of `reality.md`.

    git clone https://github.com/bimalka98/Camera-Calibration-and-Backprojection c310
    git -C c310 checkout M-CAIT-2013
    python docs/draw_reality.py c310/raw_images --lens

The repository is under the MIT licence; no frame is copied. The first half of the frames is fitted, the second half is
compared. The simulated camera shrinks 1280 x 960 pixels to 640 x 480 and sends YUYV; its frames are saved once more at
quality 95, 4:2:0, as the real ones were.
"""

from __future__ import annotations

import argparse
import io
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.fft import dctn
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.optimize import least_squares
from scipy.special import ndtr

from phibench.calibration.sensor_fit.edge_spread import Edge, edges_of, measure_edge
from phibench.calibration.sensor_fit.fit_sensor import LensFit, fit_sensor
from phibench.calibration.sensor_fit.noise_levels import decoded_by
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.processing import rgb_from_yuyv
from phibench.render.sensor.settings import Sensor, sensor

Array = NDArray[Any]
PICTURE = Path(__file__).with_name("reality.png")
LEVELS = {"dark": (28.0, 45.0), "grey": (110.0, 150.0), "bright": (190.0, 210.0)}  # codes
LAGS = {"beside": (0, 1), "below": (1, 0), "diagonal": (1, 1), "two beside": (0, 2), "two below": (2, 0)}
EVEN_CODES, EVEN_PX = 6.0, 9  # an even place: its square of so many pixels has no larger range
SAME_CODES = 2.0  # median difference of two frames of one scene
SHARPEST = 0.5  # of the frames: hands shook in the others
BLOCKS = 8  # of the jackknife, in each direction
SHRINK = 2
GREY, CODES = 125.0, (32.0, 200.0)  # of the simulated board
UNITS = {
    "rise": 0.02,
    "shoot": 0.02,
    "two": 0.15,
    "beside": 0.05,
    "below": 0.05,
    "diagonal": 0.15,
    "Y'": 0.04,
    "Cb": 0.1,
}
"""Differences that count alike in the fit: relative, but of over- and undershoot absolute."""
LUMA = (0.299, 0.587, 0.114)
STEPS = range(5, 41)
Values = dict[str, tuple[float, float]]
"""Measure to value and standard error."""


@dataclass(frozen=True)
class Column:
    """Measures of one set of frames."""

    title: str
    values: Values
    profile: tuple[Array, Array]


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


# -- noise of frames of one scene ------------------------------------------------------------------------------------


def scenes(frames: Sequence[Array]) -> list[list[Array]]:
    """Runs of frames that differ by no more than noise, two or more each."""
    runs: list[list[Array]] = []
    for frame in frames:
        if runs and float(np.median(np.abs(frame[..., 0] - runs[-1][-1][..., 0]))) <= SAME_CODES:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return [run for run in runs if len(run) > 1]


def noise(run: Sequence[Array]) -> Values:
    """Noise from frame to frame in even places, by level: rms of Y' and its correlations; Cb at the grey level."""
    luma = np.stack([frame[..., 0] for frame in run])
    mean = gaussian_filter(luma.mean(axis=0), 1.0)
    even = maximum_filter(mean, EVEN_PX) - minimum_filter(mean, EVEN_PX) <= EVEN_CODES
    found: Values = {}
    for name, (low, high) in LEVELS.items():
        place = even & (mean >= low) & (mean < high)
        found |= _correlations(f"noise {name}", _changes(luma), place, LAGS)
    place = even & (mean >= LEVELS["grey"][0]) & (mean < LEVELS["grey"][1])
    cb = _changes(np.stack([frame[..., 1] for frame in run]))
    return found | _correlations("noise of Cb, grey", cb, place, {"two beside": (0, 2), "two below": (2, 0)})


def _changes(stack: Array) -> Array:
    """Deviations from the mean of the frames, each less its own slow part: lamps and exposure drift."""
    n = len(stack)
    rest = stack - stack.mean(axis=0)
    return np.stack([one - gaussian_filter(one, 12.0) for one in rest]) * np.sqrt(n / (n - 1.0))


def _correlations(title: str, changes: Array, place: Array, lags: dict[str, tuple[int, int]]) -> Values:
    """Rms, and correlations at some lags, with the errors of a jackknife over blocks."""
    place = place.copy()
    place[:8], place[-8:], place[:, :8], place[:, -8:] = False, False, False, False
    parts = []
    for rows, columns in ((0, 0), *lags.values()):
        both = place & np.roll(place, (-rows, -columns), (0, 1))
        product = np.where(both, (changes * np.roll(changes, (-rows, -columns), (1, 2))).mean(axis=0), 0.0)
        total, count = _without_blocks(product), _without_blocks(both.astype(float))
        parts.append(total / np.maximum(count, 1.0))
    unit = " of Y', codes rms" if "Cb" not in title else ", codes rms"
    values = {f"{title}{unit}": np.sqrt(parts[0])}
    values |= {f"{title}: correlation {name}": x / parts[0] for name, x in zip(lags, parts[1:], strict=True)}
    return {name: (float(x[0]), jackknife_sigma(x)) for name, x in values.items()}


def jackknife_sigma(values: Array) -> float:
    """Standard error of the first value, from the others, each without one block."""
    left = values[1:]
    return float(np.sqrt((len(left) - 1.0) * np.mean((left - left.mean()) ** 2)))


def _without_blocks(image: Array) -> Array:
    rows, columns = (np.linspace(0, side, BLOCKS + 1).astype(int)[:-1] for side in image.shape)
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1).ravel()
    return np.concatenate([[sums.sum()], sums.sum() - sums])


# -- edges and traces of processing ----------------------------------------------------------------------------------


def edge_measures(frames: Sequence[Array], share: float) -> tuple[Values, tuple[Array, Array]]:
    """Medians of the frames with the steepest edges, with standard errors over these, and their mean profile."""
    rows = []
    for frame in frames:
        edges = list(edges_of(frame[..., 0]))
        if len(edges) >= 20:
            rows.append((np.median([list(vars(measure_edge(edge)).values()) for edge in edges], axis=0), edges))
    rows.sort(key=lambda row: float(row[0][0]))
    rows = rows[: max(int(np.ceil(share * len(rows))), 2)]
    medians = np.array([row[0] for row in rows])
    errors = medians.std(axis=0, ddof=1) / np.sqrt(len(medians))
    names = ("edge rise, px", "edge overshoot", "edge undershoot")
    values = {n: (float(m), float(e)) for n, m, e in zip(names, medians.mean(axis=0), errors, strict=True)}
    return values, profile([edge for row in rows for edge in row[1]])


def profile(edges: Sequence[Edge]) -> tuple[Array, Array]:
    """Mean edge spread function: distances, px, and shares of the step."""
    at = np.arange(-6.5, 6.5, 0.25)
    return at, np.mean([np.interp(at, *edge.profile()) for edge in edges], axis=0)


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


def column(title: str, frames: Sequence[Array], run: Sequence[Array], share: float = 1.0) -> Column:
    """All measures of some frames; noise of those of one scene."""
    edges, mean = edge_measures(frames, share)
    return Column(title, noise(run) | edges, mean)


# -- simulated frames ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """Numbers that are fitted.

    Attributes
    ----------
    white_e : electrons of white, of one of the sensor's own pixels
    sigma_px : optical blur, pixels of the frame
    sharpen, denoise, vertical, threshold_codes, chroma : settings of the chain
    saturation : factor of colour differences in linear light, by the colour matrix
    """

    white_e: float = 1000.0
    sigma_px: float = 0.33
    sharpen: float = 0.7
    denoise: float = 0.9
    vertical: float = 0.8
    threshold_codes: float = 40.0
    chroma: float = 0.95
    saturation: float = 1.4

    def sensor(self) -> Sensor:
        """The camera."""
        grey = 1.0 - self.saturation
        matrix = tuple(
            tuple(grey * weight + self.saturation * (i == j) for j, weight in enumerate(LUMA)) for i in range(3)
        )
        return sensor(
            "yuyv",
            full_well_e=1.1 * self.white_e,
            gain_dn_per_e=959.0 / self.white_e,
            read_noise_e=0.0,  # the real noise grows from dark to grey as shot noise does
            sharpen_amount=self.sharpen,
            denoise_luma=self.denoise,
            denoise_reach_px=2,
            denoise_vertical=self.vertical,
            denoise_threshold_codes=self.threshold_codes,
            denoise_chroma=self.chroma,
            colour_matrix=matrix,
        )


LOW = Settings(100.0, 0.15, 0.02, 0.02, 0.02, 4.0, 0.02, 0.5)
HIGH = Settings(20000.0, 1.5, 3.0, 1.0, 1.0, 200.0, 1.0, 3.0)


def simulated(s: Sensor, sigma_px: float, seed: int, size: tuple[int, int] = (480, 640), shrink: int = SHRINK) -> list:
    """Three frames of one scene and two of others, as YUYV, saved once more at quality 95, 4:2:0."""
    white_e = (s.top_dn - s.black_level_dn) / s.dn_per_e
    balance = np.array(s.white_balance)[:, None, None]
    frames = []
    for k, angle in enumerate((2.8, 2.8, 2.8, 4.5, 8.0)):
        light = Light(board(angle, sigma_px, size, shrink)[None] / balance * white_e / s.exposure_s)
        bytes_of = Chain(s, seed).shrunk_frame(light, NoiseStream(("reality", seed, k)), shrink)
        file = io.BytesIO()
        Image.fromarray(rgb_from_yuyv(bytes_of, s)).save(file, "JPEG", quality=95, subsampling="4:2:0")
        frames.append(ycbcr(file))
    return frames


def of_simulated(title: str, s: Sensor, sigma_px: float, seed: int, size: tuple[int, int] = (480, 640)) -> Column:
    """Measures of simulated frames."""
    frames = simulated(s, sigma_px, seed, size)
    return column(title, frames[2:], frames[:3])


def board(angle_deg: float, sigma_px: float, size: tuple[int, int], fine: int) -> Array:
    """Linear light of a blurred chessboard with fields of 40 pixels, beside a grey wall; `fine` samples a pixel."""
    height, width = size
    y, x = (np.mgrid[0.0 : height * fine, 0.0 : width * fine] + 0.5) / fine - 0.5
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))

    def stripes(t: Array) -> Array:
        t = np.mod(t, 80.0)
        return np.asarray(ndtr((t - 20.0) / sigma_px) - ndtr((t - 60.0) / sigma_px))

    u, v = stripes(c * x + s * y), stripes(-s * x + c * y)
    dark, bright, grey = decoded_by("srgb", np.array([*CODES, GREY]))
    wall = ndtr((x - 0.7 * width) / sigma_px)
    fields = dark + (bright - dark) * (u * (1.0 - v) + v * (1.0 - u))
    return np.asarray(wall * grey + (1.0 - wall) * fields)


def fitted(real: Values) -> Settings:
    """Settings whose simulated frames have the real measures, by least squares of relative differences."""
    names = [name for name in real if "two below" not in name]
    low, high = (np.array(list(vars(x).values())) for x in (LOW, HIGH))

    def differences(x: Array) -> Array:
        one = Settings(*map(float, np.exp(x)))
        found = of_simulated("", one.sensor(), one.sigma_px, 10, (320, 480)).values
        rest = []
        for name in names:
            part = next(part for part in UNITS if part in name)
            unit = UNITS[part] * (1.0 if "shoot" in name else real[name][0])
            rest.append((found[name][0] - real[name][0]) / unit)
        print("  ".join(f"{v:.3g}" for v in np.exp(x)), f"misfit {np.sum(np.square(rest)):.1f}", flush=True)
        return np.array(rest)

    start = np.log(list(vars(Settings()).values()))
    bounds = (np.log(low), np.log(high))
    first = np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6)
    # seeds are fixed; yet a small step would see the noise of the medians: 6 to 20 % of a number (steps are relative)
    steps = 0.08 / np.maximum(np.abs(first), 0.2)
    done = least_squares(differences, first, bounds=bounds, diff_step=steps, max_nfev=6)
    return Settings(*map(float, np.exp(done.x)))


# -- page ------------------------------------------------------------------------------------------------------------


def table(columns: Sequence[Column]) -> str:
    """Markdown: value and 95 % interval of each measure, and the last column over the second."""
    titles = [one.title for one in columns]
    lines = [f"| measure | {' | '.join(titles)} | {titles[-1]} / {titles[1]} |", "|---" * (len(columns) + 2) + "|"]
    for name in columns[0].values:
        cells = [f"{mean:.3f} +- {1.96 * error:.3f}" for mean, error in (one.values[name] for one in columns)]
        (there, a), (here, b) = columns[1].values[name], columns[-1].values[name]
        ratio = here / there
        half = 1.96 * abs(ratio) * np.hypot(a / there, b / here)
        lines.append(f"| {name} | {' | '.join(cells)} | {ratio:.2f} +- {half:.2f} |")
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
    """Edge spread functions, and correlations of the noise."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained", width_ratios=(3, 2))
    for one, style in zip(columns, ("k-", "k:", "C0--", "C1-"), strict=False):
        left.plot(*one.profile, style, label=one.title)
        values = [one.values[f"noise grey: correlation {lag}"] for lag in LAGS]
        right.errorbar(range(len(LAGS)), [v for v, _ in values], [1.96 * e for _, e in values], fmt=style, capsize=2)
    left.set(xlabel="distance from the edge, px", ylabel="share of the step", xlim=(-4, 4))
    right.set(xticks=range(len(LAGS)), xticklabels=list(LAGS), ylabel="correlation of the noise, grey", ylim=(0, 1))
    right.tick_params(axis="x", rotation=40)
    left.legend()
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lens", action="store_true")
    options = parser.parse_args()
    paths = sorted(options.folder.glob("*.jpg"), key=lambda path: int(re.sub(r"\D", "", path.stem)))
    frames = [ycbcr(path) for path in paths]
    middle = len(frames) // 2
    halves = (("real, fitted", frames[:middle]), ("real, compared", frames[middle:]))
    real = [column(title, half, scenes(half)[0], SHARPEST) for title, half in halves]
    one = fitted(real[0].values)
    print(one)
    columns = [
        *real,
        of_simulated("preset", sensor("yuyv"), 0.35, 1),
        of_simulated("simulated", one.sensor(), one.sigma_px, 2),
    ]
    combs = [[comb(f[..., 0]) for f in some] for some in (frames, [sent(path) for path in paths])]
    print(
        f"DCT comb: real {np.mean(combs[0]):.2f} (largest {max(combs[0]):.2f}); the same frames after a JPEG of "
        f"quality 76 {np.mean(combs[1]):.2f} (least {min(combs[1]):.2f})"
    )
    print(f"\n{len(frames)} real frames\n\n{table(columns)}")
    draw(columns)
    if options.lens and (found := lens(paths)) is not None:
        print(f"\nlens, {found.views} of {found.given} views, corners {found.rms_px:.2f} px rms")
        for name, value in found.values.items():
            print(f"| {name} | {value:.5g} | {found.sigmas[name]:.2g} |")


if __name__ == "__main__":
    main()
