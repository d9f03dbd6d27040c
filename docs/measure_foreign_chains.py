"""Pairs that went through foreign chains, measured: how far D and spots are off, and what `measure` says of it.

Run `python docs/measure_foreign_chains.py DATASET [CHAIN ...]`. Five pairs of the data set of the recipe `paper` are
drawn as DN, R, G, B of 8 bits and JPEG. Each chain makes other files of them: turned, mirrored, decoded, stored again,
interpolated by OpenCV, scaled, sharpened, or given other colours. Each is measured with the rig of the recipe.

A case counts as told where a sentence says that sigma does not hold, and as refused where there is no D.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.calibration.captures.measure import Measurement, measure, read_setting
from phibench.calibration.captures.pair_photos import PairPhotos, PositionPhotos
from phibench.calibration.captures.picture_files import read_photo
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample, open_dataset

SAMPLES = (
    "table1-d2.180-h1.000",
    "table2-d3.180-h0.425",
    "table4-d1.975-h0.425",
    "table4-d2.950-h0.425",
    "table4-d3.970-h0.425",
)
NAMES = ("down", "up", "down_off", "up_off")
_PRESETS = {"bayer-raw": "png", "srgb8": "png", "mjpeg": "jpg"}
_BLACK, _TOP = 64, 1023  # DN of the preset bayer-raw
_BALANCE = np.array([1.0117, 1.0, 1.3416])  # and its gains of R, G, B
_MOST_SIGMAS = 4.0
Pixels = NDArray[Any]


@dataclass(frozen=True)
class Source:
    """One frame as drawn: DN (H, W) of 16 bits, R, G, B (H, W, 3) of 8 bits, and the bytes of a JPEG."""

    raw: Pixels
    rgb: Pixels
    jpeg: bytes

    @property
    def decoded(self) -> Pixels:
        """Pixels of the JPEG."""
        return np.array(Image.open(io.BytesIO(self.jpeg)))


@dataclass(frozen=True)
class Chain:
    """Bytes of a file, its suffix, keys of `[rig]` that a chain changes, and where a pixel (u, v) comes to lie."""

    make: Callable[[Source], bytes]
    suffix: str = "png"
    rig: str = ""
    place: Callable[[Pixels], Pixels] = lambda uv: uv


# -- files ------------------------------------------------------------------------------------------------------------


def png(pixels: Pixels) -> bytes:
    """PNG of 8 or 16 bits."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", compress_level=1)
    return file.getvalue()


def jpeg(pixels: Pixels, quality: int, subsampling: str = "4:2:0") -> bytes:
    """JPEG by libjpeg."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=subsampling)
    return file.getvalue()


def of_jpeg(pixels: Pixels, quality: int, subsampling: str = "4:2:0") -> bytes:
    """PNG of a decoded JPEG."""
    return png(np.array(Image.open(io.BytesIO(jpeg(pixels, quality, subsampling)))))


def video(pixels: Pixels, codec: str = "mp4v") -> bytes:
    """PNG of the first frame of a video."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "video.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*codec), 30.0, (pixels.shape[1], pixels.shape[0]))
        for _ in range(3):
            writer.write(np.ascontiguousarray(pixels[..., ::-1]))
        writer.release()
        done, frame = cv2.VideoCapture(path).read()
    assert done, "OpenCV reads what it wrote"
    return png(np.ascontiguousarray(frame[..., ::-1]))


# -- processing -------------------------------------------------------------------------------------------------------


def curve(linear: Pixels, gamma: float | None = None) -> Pixels:
    """Codes of linear light, sRGB's or a power's."""
    x = np.clip(linear, 0.0, 1.0)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * (srgb if gamma is None else x ** (1.0 / gamma))).astype(np.uint8)


def linear_of(codes: Pixels) -> Pixels:
    """Linear light of codes of sRGB."""
    x = codes / 255.0
    return np.asarray(np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4))


def developed(raw: Pixels, method: int, gamma: float | None = None) -> Pixels:
    """R, G, B of 8 bits by a demosaicing of OpenCV, with the camera's white balance."""
    deep = np.clip((raw.astype(float) - _BLACK) * (65535.0 / (_TOP - _BLACK)), 0.0, 65535.0)
    if method == cv2.COLOR_BayerRGGB2RGB_VNG:  # of 8 bits only: on codes, as a driver does it
        balanced = np.empty((*raw.shape, 3))
        balanced[:] = deep[..., None] / 65535.0 * _BALANCE
        mosaic = np.where(
            _sites(raw, 0), balanced[..., 0], np.where(_sites(raw, 2), balanced[..., 2], balanced[..., 1])
        )
        return np.asarray(cv2.demosaicing(curve(mosaic), method))
    planes = cv2.demosaicing(deep.astype(np.uint16), method) / 65535.0
    return curve(planes * _BALANCE, gamma)


def _sites(raw: Pixels, colour: int) -> Pixels:
    v, u = np.indices(raw.shape) % 2
    return np.asarray(u + v == colour)


def malvar(raw: Pixels) -> Pixels:
    """R, G, B of 8 bits by the linear filters of Malvar, He and Cutler (2004)."""
    x = (raw.astype(float) - _BLACK) / (_TOP - _BLACK)
    kernels = {
        "g": [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]],
        "row": [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]],
        "far": [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]],
    }
    done = {
        name: cv2.filter2D(x, -1, np.array(kernel) / 8.0, borderType=cv2.BORDER_REFLECT_101)
        for name, kernel in kernels.items()
    }
    done["column"] = cv2.filter2D(x, -1, np.array(kernels["row"]).T / 8.0, borderType=cv2.BORDER_REFLECT_101)
    v, u = np.indices(x.shape) % 2
    red, blue, of_red = (u == 0) & (v == 0), (u == 1) & (v == 1), (v == 0) & (u == 1)
    r = np.select([red, of_red, blue], [x, done["row"], done["far"]], done["column"])
    b = np.select([blue, of_red, red], [x, done["column"], done["far"]], done["row"])
    g = np.where(red | blue, done["g"], x)
    return curve(np.stack([r, g, b], axis=-1) * _BALANCE)


def halved(raw: Pixels) -> Pixels:
    """Picture of a quarter of the pixels: each 2 x 2 of the mosaic is one."""
    x = (raw.astype(float) - _BLACK) / (_TOP - _BLACK)
    planes = x[::2, ::2], 0.5 * (x[::2, 1::2] + x[1::2, ::2]), x[1::2, 1::2]
    return curve(np.stack(planes, axis=-1) * _BALANCE)


def scaled(pixels: Pixels, factor: float, method: int) -> Pixels:
    """Picture of another size; pixel u comes to lie at factor (u + 1/2) - 1/2."""
    size = (round(pixels.shape[1] * factor), round(pixels.shape[0] * factor))
    return np.asarray(cv2.resize(pixels, size, interpolation=method))


def sharpened(pixels: Pixels, amount: float, sigma: float) -> Pixels:
    """Unsharp mask."""
    soft = cv2.GaussianBlur(pixels, (0, 0), sigma)
    return np.asarray(cv2.addWeighted(pixels, 1.0 + amount, soft, -amount, 0.0))


def by_chroma(pixels: Pixels, change: Callable[[Pixels], Pixels]) -> Pixels:
    """Picture whose Cb and Cr are changed."""
    ycc = cv2.cvtColor(pixels, cv2.COLOR_RGB2YCrCb)
    for k in (1, 2):
        ycc[..., k] = change(ycc[..., k])
    return np.asarray(cv2.cvtColor(ycc, cv2.COLOR_YCrCb2RGB))


def saturated(chroma: Pixels) -> Pixels:
    """Cb or Cr of a picture with 1.4 times its colour."""
    return np.clip(128.0 + 1.4 * (chroma - 128.0), 0.0, 255.0).astype(np.uint8)


def times(pixels: Pixels, *factors: float) -> Pixels:
    """Codes times factors."""
    return np.clip(np.rint(pixels * np.array(factors)), 0, 255).astype(np.uint8)


# -- chains -----------------------------------------------------------------------------------------------------------

_TURNS: dict[str, tuple[Callable[[Pixels], Pixels], Callable[[Pixels], Pixels]]] = {
    "mirrored": (lambda x: x[:, ::-1], lambda uv: np.array([1279.0, 0.0]) + [-1, 1] * uv),
    "upside-down": (lambda x: x[::-1], lambda uv: np.array([0.0, 719.0]) + [1, -1] * uv),
    "turned": (lambda x: x[::-1, ::-1], lambda uv: np.array([1279.0, 719.0]) - uv),
}


def _turned() -> Iterator[tuple[str, Chain]]:
    for name, (turn, place) in _TURNS.items():

        def of(part: Callable[[Source], Pixels], turn: Callable[[Pixels], Pixels] = turn) -> Callable[[Source], Pixels]:
            return lambda s: np.ascontiguousarray(turn(part(s)))

        rgb, raw, decoded = of(lambda s: s.rgb), of(lambda s: s.raw), of(lambda s: s.decoded)
        yield f"{name}, PNG", Chain(lambda s, f=rgb: png(f(s)), place=place)  # type: ignore[misc]
        yield f"{name}, DN", Chain(lambda s, f=raw: png(f(s)), place=place)  # type: ignore[misc]
        yield f"{name}, JPEG 76", Chain(lambda s, f=rgb: jpeg(f(s), 76, "4:2:2"), "jpg", place=place)  # type: ignore[misc]
        yield f"{name}, JPEG 76 as PNG", Chain(lambda s, f=decoded: png(f(s)), place=place)  # type: ignore[misc]


def _sized(width: int, height: int) -> str:
    factor = width / 1280.0
    return (
        f"width_px = {width}\nheight_px = {height}\nfx_px = {1430.0 * factor}\nfy_px = {1430.0 * factor}\n"
        f"cx_px = {factor * 640.0 - 0.5}\ncy_px = {factor * 360.0 - 0.5}\npixel_pitch_um = {2.8 / factor}\n"
        f"blur_sigma_px = {0.7 * factor}\n"
    )


def _placed(factor: float) -> Callable[[Pixels], Pixels]:
    return lambda uv: factor * (uv + 0.5) - 0.5


_CUT = "width_px = 1272\nheight_px = 712\nfx_px = 1430.0\nfy_px = 1430.0\ncx_px = 634.5\ncy_px = 356.5\n"

CHAINS: dict[str, Chain] = dict(_turned()) | {
    "JPEG 76 as PNG": Chain(lambda s: png(s.decoded)),
    "JPEG 60 4:2:0 as PNG": Chain(lambda s: of_jpeg(s.rgb, 60)),
    "JPEG 85 4:2:0 as PNG": Chain(lambda s: of_jpeg(s.rgb, 85)),
    "JPEG 90 4:4:4 as PNG": Chain(lambda s: of_jpeg(s.rgb, 90, "4:4:4")),
    "JPEG 95 4:2:2 as PNG": Chain(lambda s: of_jpeg(s.rgb, 95, "4:2:2")),
    "JPEG 76 cut off its grid, PNG": Chain(
        lambda s: png(np.ascontiguousarray(s.decoded[3:715, 5:1277])), rig=_CUT, place=lambda uv: uv - [5.0, 3.0]
    ),
    "JPEG 76 stored as JPEG 95": Chain(lambda s: jpeg(s.decoded, 95), "jpg"),
    "JPEG 76 stored as JPEG 90 4:4:4": Chain(lambda s: jpeg(s.decoded, 90, "4:4:4"), "jpg"),
    "frame of a video, PNG": Chain(lambda s: video(s.rgb)),
    "OpenCV bilinear": Chain(lambda s: png(developed(s.raw, cv2.COLOR_BayerRGGB2RGB))),
    "OpenCV edge-aware": Chain(lambda s: png(developed(s.raw, cv2.COLOR_BayerRGGB2RGB_EA))),
    "OpenCV VNG of codes": Chain(lambda s: png(developed(s.raw, cv2.COLOR_BayerRGGB2RGB_VNG))),
    "Malvar": Chain(lambda s: png(malvar(s.raw))),
    "OpenCV edge-aware, JPEG 76": Chain(
        lambda s: jpeg(developed(s.raw, cv2.COLOR_BayerRGGB2RGB_EA), 76, "4:2:2"), "jpg"
    ),
    "OpenCV edge-aware, JPEG 92": Chain(lambda s: jpeg(developed(s.raw, cv2.COLOR_BayerRGGB2RGB_EA), 92), "jpg"),
    "Malvar, JPEG 85": Chain(lambda s: jpeg(malvar(s.raw), 85), "jpg"),
    "2 x 2 of the mosaic, enlarged": Chain(lambda s: png(scaled(halved(s.raw), 2.0, cv2.INTER_LINEAR))),
    "scaled to half": Chain(
        lambda s: png(scaled(s.rgb, 0.5, cv2.INTER_AREA)), rig=_sized(640, 360), place=_placed(0.5)
    ),
    "scaled to 3/4": Chain(
        lambda s: png(scaled(s.rgb, 0.75, cv2.INTER_LANCZOS4)), rig=_sized(960, 540), place=_placed(0.75)
    ),
    "scaled to 3/2": Chain(
        lambda s: png(scaled(s.rgb, 1.5, cv2.INTER_CUBIC)), rig=_sized(1920, 1080), place=_placed(1.5)
    ),
    "sharpened a little": Chain(lambda s: png(sharpened(s.rgb, 0.4, 1.0))),
    "sharpened much": Chain(lambda s: png(sharpened(s.rgb, 1.2, 1.5))),
    "sharpened, JPEG 85": Chain(lambda s: jpeg(sharpened(s.rgb, 0.8, 1.0), 85), "jpg"),
    "gamma 2.2": Chain(lambda s: png(developed(s.raw, cv2.COLOR_BayerRGGB2RGB, 2.2))),
    "gamma 1.0": Chain(lambda s: png(developed(s.raw, cv2.COLOR_BayerRGGB2RGB, 1.0))),
    "brightened": Chain(lambda s: png(curve(linear_of(s.rgb) ** 0.8))),
    "white balance of codes": Chain(lambda s: png(times(s.rgb, 0.8, 1.0, 1.15))),
    "white balance of light": Chain(lambda s: png(curve(linear_of(s.rgb) * [0.7, 1.0, 1.3]))),
    "more colour": Chain(lambda s: png(by_chroma(s.rgb, saturated))),
    "chroma smoothed": Chain(lambda s: png(by_chroma(s.rgb, lambda c: cv2.GaussianBlur(c, (0, 0), 2.0)))),
    "median 3 x 3": Chain(lambda s: png(cv2.medianBlur(s.rgb, 3))),
    "bilateral filter": Chain(lambda s: png(cv2.bilateralFilter(s.rgb, 5, 20.0, 2.0))),
}


# -- measuring --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Outcome of one case: pulls of D and of the spots (root mean square of a coordinate), and what was said."""

    sample: Sample
    found: Measurement | None
    words: str
    place: Callable[[Pixels], Pixels]

    @property
    def depth_pull(self) -> float:
        """Error of D over sigma; NaN where it is refused."""
        return np.nan if self.found is None else (self.found.depth_m - self.sample.row.depth_m) / self.found.sigma_m

    @property
    def spot_pull(self) -> float:
        """The larger one of both spots' distances over their sigma, by the covariance; NaN where it is refused."""
        if self.found is None:
            return np.nan
        pulls = []
        for spot, true in ((self.found.down, self.sample.row.down), (self.found.up, self.sample.row.up)):
            off = spot.uv_px - self.place(np.array([true.u_px, true.v_px]))
            pulls.append(float(np.sqrt(off @ np.linalg.solve(spot.covariance_px2, off))))
        return max(pulls)

    @property
    def silent(self) -> bool:
        """Beyond 4 sigma without a word: D by one degree of freedom, a spot by two (4.4 is as rare)."""
        return not self.words and (abs(self.depth_pull) > _MOST_SIGMAS or self.spot_pull > _MOST_SIGMAS + 0.4)


def measured(chain: Chain, sources: dict[str, Source], sample: Sample, folder: Path) -> Outcome:
    """Measure one pair as a chain delivers it."""
    rig = folder / "rig.toml"
    rig.write_text(f"[rig]\n{chain.rig}")
    setting, read = read_setting(rig), {}
    try:
        for name in NAMES:
            path = folder / f"{name}.{chain.suffix}"
            path.write_bytes(chain.make(sources[name]))
            read[name] = (read_photo(path, setting.known.rig),)
        photos = PairPhotos(PositionPhotos(read["down"], read["down_off"]), PositionPhotos(read["up"], read["up_off"]))
        found = measure(photos, sample.row.nominal_stroke_m, setting)
    except DatasetError as error:
        return Outcome(sample, None, f"refused: {error}".replace(str(folder), ""), chain.place)
    return Outcome(sample, found, "; ".join(found.doubts), chain.place)


def drawn(dataset: Path, folder: Path) -> dict[str, dict[str, Source]]:
    """Frames of the pairs, by sample and name, at an automatic exposure."""
    command = [sys.executable, "-m", "phibench", "dataset", "frames", str(dataset), "--laser-off", "--workers", "1"]
    for preset in _PRESETS:
        options = ["--exposure", "auto", "--preset", preset, "--out", str(folder / preset), "--sample", *SAMPLES]
        subprocess.run([*command, *options], check=True, capture_output=True)

    def source(sample: str, name: str) -> Source:
        position, _, off = name.partition("_")
        raw, rgb, jpg = (
            folder / preset / f"{sample}-{position}-{off or 'on'}-0000.{suffix}" for preset, suffix in _PRESETS.items()
        )
        return Source(np.array(Image.open(raw)).astype(np.uint16), np.array(Image.open(rgb)), jpg.read_bytes())

    return {sample: {name: source(sample, name) for name in NAMES} for sample in SAMPLES}


def main() -> None:
    """Print a line for each chain, and the counts."""
    dataset, wanted = Path(sys.argv[1]), [name for name in sys.argv[2:] if name != "-v"] or list(CHAINS)
    samples = {sample.row.sample_id: sample for sample in open_dataset(dataset)}
    counts = dict.fromkeys(("cases", "told", "refused", "silent"), 0)
    print(f"{'chain':34s} {'pulls of D':36s} {'largest of spots':>17s} {'sigma, m':>9s}  told")
    with tempfile.TemporaryDirectory() as name:
        frames = drawn(dataset, Path(name))
        for chain in wanted:
            found = [measured(CHAINS[chain], frames[s], samples[s], Path(name)) for s in SAMPLES]
            pulls = " ".join(f"{one.depth_pull:+6.2f}" for one in found)
            sigmas = [one.found.sigma_m for one in found if one.found]
            told, refused = (sum(bool(one.words) for one in found), sum(one.found is None for one in found))
            silent = sum(one.silent for one in found)
            worst = np.nanmax([0.0, *(one.spot_pull for one in found)])
            typical = np.median(sigmas) if sigmas else np.nan
            words = (
                f"{told} of {len(found)}" + (f", {refused} refused" if refused else "") + ("  SILENT" * bool(silent))
            )
            print(f"{chain:34s} {pulls:36s} {worst:17.1f} {typical:9.4f}  {words}", flush=True)
            for key, more in zip(counts, (len(found), told - refused, refused, silent), strict=True):
                counts[key] += more
            if "-v" in sys.argv:
                print("\n".join(f"    {one.words}" for one in found if one.words))
    print(
        f"{len(wanted)} chains, {counts['cases']} pairs: {counts['told']} with a word, {counts['refused']} refused, "
        f"{counts['silent']} beyond {_MOST_SIGMAS:g} sigma without a word"
    )


if __name__ == "__main__":
    main()
