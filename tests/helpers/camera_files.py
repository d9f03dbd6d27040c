"""Camera files of a sample, as a person with a real rig has them: pictures of both positions and a rig file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from phibench.datasets.frames.frame_files import png_bytes
from phibench.datasets.frames.frame_request import Exposure
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.drawn_pairs import DrawnPairs, pairs_of
from phibench.scenes.rig import Rig

NAMES = ("down", "up", "down_off", "up_off")


def rig_text(rig: Rig) -> str:
    """`[rig]` with the numbers of a rig that a person can measure."""
    camera = rig.camera
    lines = [f"z_c_m = {rig.sphere_in_camera_m[2]}", f"radius_m = {rig.sphere.radius_m}"]
    keys = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "pixel_pitch_um", "f_number")
    lines += [f"{key} = {getattr(camera, key)}" for key in keys]
    return "\n".join(("[rig]", *lines, ""))


def write_pictures(
    dataset: Dataset, sample: Sample, folder: Path, preset: str, draws: int = 1, exposure: Exposure = "auto"
) -> dict[str, list[Path]]:
    """Pictures by name, one for each draw of the noise; and `rig.toml` beside them."""
    folder.mkdir(parents=True, exist_ok=True)
    pairs = pairs_of(dataset, [sample], preset, draws)
    exposed = (replace(one, request=replace(one.request, exposure=exposure)) for one in pairs.pair_draws)
    pairs = DrawnPairs(pairs.dataset, tuple(exposed))
    files: dict[str, list[Path]] = {name: [] for name in NAMES}
    for number in range(len(pairs)):
        _, frames = pairs.pair_and_frames(number)
        for name, frame in frames.by_name.items():
            end = "png" if frame.jpeg is None else "jpg"
            path = folder / f"{name}-{number}.{end}"
            path.write_bytes(png_bytes(frame.image) if frame.jpeg is None else frame.jpeg)
            files[name].append(path)
    (folder / "rig.toml").write_text(rig_text(sample.nominal_rig), encoding="utf-8")
    return files
