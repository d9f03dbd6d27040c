"""Drawings of docs/sensor.md from a data set. Run `PYTHONPATH=tests python docs/draw_sensor.py DATASET SAMPLE`.

`sensor_steps.png` shows the same spot at every step of the chain, `sensor_frame.jpg` is a frame as the camera sends it,
`photon_transfer.png` is the photon-transfer curve of the preset `mono-raw`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

from helpers.photon_transfer import Stack
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from numpy.typing import NDArray

from phibench.datasets.frames.frame_source import FrameSource
from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.store.files import write_bytes
from phibench.render.sensor import processing
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import (
    NoiseStream,
    collected_charge,
    expected_electrons,
    frame_stream,
    mean_charge,
    whole_tiles,
)
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.processing import compressed, linear_rgb, linear_signal
from phibench.render.sensor.settings import Sensor, sensor
from phibench.render.sensor.srgb import srgb_encoded

_POSITION, _SIDE_PX, _ZOOM = "down", 24, 16
_FOLDER = Path(__file__).parent
Picture = NDArray[np.uint8]


def steps(source: FrameSource) -> list[tuple[str, Picture]]:
    """The region of the spot after every step, as pictures (h, w, 3), each with its caption."""
    side, names = source.sides[_POSITION], (*source.names, _POSITION)
    chain, light, region, s = side.chain, side.light, side.region, side.chain.sensor
    stream = frame_stream(*names, laser=True, draw=0)
    tiles, size = whole_tiles(region, light.size), light.size
    cut = region.slices(tiles)
    ideal = Chain(sensor("ideal"), 0, chain.camera)
    planes = expected_electrons(light, ideal.sensor, chain.camera, region)
    spot_alone = planes - expected_electrons(light.laser_off(), ideal.sensor, chain.camera, region)
    pattern = chain.pattern(tiles)
    photo = chain.photo_electrons(light, tiles)
    mean = mean_charge(photo, s, pattern)
    charge = collected_charge(mean, s, stream, tiles)
    box = chain.raw_region(region, size)
    raw = chain.raw(light, stream, box)
    linear = linear_rgb(linear_signal(raw, s, np.float32), s)
    unbalanced = processing.demosaic(linear_signal(raw, s, np.float32))
    inner = (..., *region.slices(box))
    whole = chain.jpeg_region(region, size)
    eight = chain.developed(light, stream, whole)
    jpeg = compressed(eight, s)[region.slices(whole)]
    full_e = (s.top_dn - s.black_level_dn) / s.dn_per_e
    return [
        ("spot layer, 1/60 s", shown(spot_alone / full_e)),
        ("+ ambient layer", shown(planes / full_e)),
        ("RGGB mosaic, as grey", grey(photo[cut] / full_e)),
        ("PRNU, dark current", grey(mean[cut] / full_e)),
        ("shot noise, full well", grey(charge[cut] / full_e)),
        ("read noise, 10 bits", grey(linear_signal(raw, s)[region.slices(box)])),
        ("demosaicing", shown(unbalanced[inner])),
        ("white balance, matrix", shown(linear[inner])),
        ("sRGB, 8 bits", eight[region.slices(whole)]),
        (f"JPEG {s.jpeg_subsampling}, quality {s.jpeg_quality}", jpeg),
    ]


def shown(planes: NDArray[np.floating]) -> Picture:
    """Linear planes, full scale 1, as a screen shows them."""
    return processing.eight_bit(srgb_encoded(np.asarray(planes, float)))


def grey(values: NDArray[np.floating]) -> Picture:
    """A mosaic as it lies in the memory: one value per pixel, whatever its filter."""
    return shown(np.broadcast_to(values, (3, *values.shape)))


def draw_steps(sample: Sample, path: Path) -> None:
    """Ten panels of the same pixels."""
    panels = steps(sample.region_frames("mjpeg", _SIDE_PX, exposure=None))
    figure, axes = plt.subplots(2, 5, figsize=(8.0, 3.9), layout="constrained")
    for number, (axis, (caption, picture)) in enumerate(zip(axes.flat, panels, strict=True), 1):
        axis.imshow(np.kron(picture, np.ones((_ZOOM, _ZOOM, 1), np.uint8)), interpolation="none")
        axis.set_title(f"{number}  {caption}", fontsize=8, loc="left")
        axis.set_axis_off()
    figure.savefig(path, dpi=100, metadata={"Software": None})


def curve(base: Sensor, levels_e: NDArray[np.floating], seed: int = 0) -> list[Stack]:
    """Mean and variances of 16 frames of 128 x 128 pixels at several levels of light, black level taken off."""
    stacks = []
    for k, level in enumerate(levels_e):
        light = Light.flat((float(level) / base.exposure_s, 0.0, 0.0), (128, 128))
        frames = [Chain(base, seed).frame(light, NoiseStream(("transfer", k, i))) for i in range(16)]
        stacks.append(Stack.of(base.exposure_s, np.stack(frames)))
    return stacks


def draw_transfer(path: Path) -> None:
    """Variance against mean, with the laws that it follows."""
    s = sensor("mono-raw", full_well_e=11000.0)
    K = s.dn_per_e
    stacks = curve(s, np.geomspace(4.0, 14000.0, 60))
    signal = np.array([stack.mean_dn for stack in stacks]) - s.black_level_dn
    temporal, spatial = (
        np.array([getattr(stack, name) for stack in stacks]) for name in ("temporal_dn2", "spatial_dn2")
    )
    line = np.geomspace(0.2, 960.0, 200)
    read = K**2 * s.read_noise_e**2 + 1.0 / 12.0
    figure, axis = plt.subplots(figsize=(7.0, 4.8), layout="constrained")
    axis.loglog(signal, temporal + spatial, "s", ms=4, mfc="none", color="tab:orange", label="one frame: all noise")
    axis.loglog(signal, temporal, "o", ms=4, color="tab:blue", label="from frame to frame: temporal noise")
    axis.loglog(line, K * line, ":", color="k", lw=1, label=f"shot noise, slope 1: K x signal, K = {K:.4f} DN/e-")
    axis.loglog(line, (s.prnu * line) ** 2, "--", color="tab:green", lw=1, label=f"PRNU {100 * s.prnu:g} %, slope 2")
    axis.axhline(read, ls="-.", color="tab:red", lw=1, label=f"read noise {s.read_noise_e:g} e- and rounding")
    axis.axvline(K * s.full_well_e, color="0.5", lw=1)
    _label_well(axis, K * s.full_well_e, s.full_well_e)
    axis.set(xlabel="signal: mean - black level (DN)", ylabel="variance (DN$^2$)", xlim=(0.2, 1300), ylim=(0.03, 300))
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter("{x:g}")
    axis.legend(fontsize=8, loc="upper left")
    axis.grid(which="both", lw=0.3)
    figure.savefig(path, dpi=96, metadata={"Software": None})


def _label_well(axis: Axes, signal_dn: float, full_well_e: float) -> None:
    axis.text(signal_dn * 0.95, 0.4, f"full well {full_well_e:g} e-", rotation=90, fontsize=8, ha="right")


def main() -> None:
    """Write the pictures beside this file."""
    folder, sample_id = sys.argv[1:]
    sample = open_dataset(folder)[sample_id]
    draw_steps(sample, _FOLDER / "sensor_steps.png")
    frame = sample.frame_source("mjpeg", exposure="auto", jpeg_quality=75).frame(_POSITION)
    assert frame.jpeg is not None
    assert frame.region == Region.whole(frame.image.shape[:2])
    write_bytes(_FOLDER / "sensor_frame.jpg", frame.jpeg)
    print(f"sensor_frame.jpg: exposure {frame.sensor.exposure_s:.4f} s, gain {frame.sensor.analogue_gain:.2f}")
    draw_transfer(_FOLDER / "photon_transfer.png")


if __name__ == "__main__":
    main()
