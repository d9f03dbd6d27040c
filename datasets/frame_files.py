"""A frame as a file that other programs read: PNG, the camera's own JPEG, or EXR; and a picture of it for people."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.datasets.exr import write_exr
from phibench.datasets.files import write_bytes
from phibench.datasets.frames import Frame
from phibench.render import isp
from phibench.render.sensor import Sensor
from phibench.scenes.detector import FILTERS

VALUES = {
    "electrons": "expected electrons in one exposure behind R, G, B, float32",
    "raw": "DN of the converter, not scaled, in 16 bits; RGGB by the pixel's place on the sensor",
    "srgb8": "sRGB, 8 bits",
    "mjpeg": "sRGB, 8 bits, as the camera sends it",
}
PREVIEW = "sRGB, 8 bits, for people; not the camera's"


def suffix(sensor: Sensor, whole: bool) -> str:
    """End of the file's name; a part of an MJPEG frame is no JPEG file of the camera and goes into a PNG."""
    if sensor.output == "electrons":
        return ".exr"
    return ".jpg" if sensor.output == "mjpeg" and whole else ".png"


def has_preview(sensor: Sensor) -> bool:
    """Whether a picture for people is wanted, because the frame itself is dark or unreadable to a viewer."""
    return sensor.output in ("electrons", "raw")


def write_frame(path: Path, frame: Frame, names: tuple[str, int, str]) -> Path:
    """Write one frame, atomically; `names` are data set, seed and sample id for the EXR's header."""
    if frame.sensor.output == "electrons":
        header = {"kind": "frame", "unit": "electrons", "exposure_s": frame.sensor.exposure_s}
        header |= dict(zip(("dataset", "dataset_seed", "sample_id"), names, strict=True))
        header |= {"position": frame.position, "laser": frame.laser, "draw": frame.draw}
        planes = dict(zip(FILTERS, frame.image, strict=True))
        return write_exr(path, planes, header, (frame.region.u0_px, frame.region.v0_px))
    return write_bytes(path, frame.jpeg if frame.jpeg is not None else png_bytes(frame.image))


def write_preview(path: Path, frame: Frame) -> Path:
    """Write the picture of a frame, atomically."""
    return write_bytes(path, png_bytes(preview(frame)))


def png_bytes(image: NDArray[Any]) -> bytes:
    """PNG of an image, shape (h, w) of 16 bits or (h, w, 3) of 8 bits."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


def preview(frame: Frame) -> NDArray[np.uint8]:
    """Picture of a frame of electrons or DN as the preset's processing would show it, shape (h, w, 3)."""
    sensor = frame.sensor
    if sensor.output == "raw":
        # interpolation starts at a red pixel and needs two rows and columns: reflection keeps the filters' order
        before = frame.region.v0_px % 2, frame.region.u0_px % 2
        padded = frame.image
        for axis, (first, length) in enumerate(zip(before, frame.image.shape, strict=True)):
            width = [(0, 0), (0, 0)]
            width[axis] = (first, 1)
            padded = np.pad(padded, width, mode="reflect" if length > 1 else "edge")
        linear = isp.linear_rgb(isp.linear_signal(padded, sensor, np.float32), sensor)
        height, length = frame.image.shape
        linear = linear[..., before[0] : before[0] + height, before[1] : before[1] + length]
    else:
        full_scale_e = (sensor.top_dn - sensor.black_level_dn) / sensor.dn_per_e
        linear = isp.white_balanced(frame.image / full_scale_e, sensor.white_balance)
        linear = isp.colour_corrected(linear, sensor.colour_matrix)
    return isp.eight_bit(isp.rendered(linear, sensor))
