"""Drawing of docs/measure.jpg: a simulated pair, written as camera files and measured from them.

Run `python docs/draw_measure.py DATASET SAMPLE`. The picture in the page is of the data set of `tests/one_rig.toml`.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from PIL import Image

from phibench.calibration.captures.measure import MeasureSetting, PairPhotos, PositionPhotos, measure
from phibench.calibration.captures.measure_picture import draw_measurement
from phibench.calibration.captures.picture_files import read_photo
from phibench.calibration.captures.rig_file import MeasuredRig
from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.read import open_dataset
from phibench.estimator.drawn_pairs import pairs_of
from phibench.scenes.room import default_rig

_WIDTH = 1000
_QUALITY = 80


def main() -> None:
    """Write the picture beside this file."""
    dataset = open_dataset(sys.argv[1])
    sample = dataset[sys.argv[2]]
    _, frames = pairs_of(dataset, [sample], "mjpeg").pair_and_frames(0)
    with tempfile.TemporaryDirectory() as folder:
        photos = []
        for name in ("down", "up", "down_off", "up_off"):
            frame, path = frames.by_name[name], Path(folder) / f"{name}.jpg"
            path.write_bytes(png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
            photos.append(read_photo(path, default_rig()))
        down, up = (PositionPhotos((photos[k],), (photos[k + 2],)) for k in (0, 1))
        setting = MeasureSetting(MeasuredRig(default_rig(), None))
        found = measure(PairPhotos(down, up), sample.row.nominal_stroke_m, setting)
    picture = draw_measurement(replace(found, notes=found.notes[-1:]), f"true D = {sample.row.depth_m:.3f} m")
    height = round(picture.height * _WIDTH / picture.width)
    shrunk = picture.resize((_WIDTH, height), Image.Resampling.LANCZOS)
    shrunk.save(Path(__file__).with_name("measure.jpg"), quality=_QUALITY, optimize=True)


if __name__ == "__main__":
    main()
