"""Interactive page of a dense answer: panoramas, D true and answered, counterparts, causes, the bound, and the room.

One HTML file that fetches nothing, with frame, style and tools of the page of a sample. Values travel as 16-bit numbers
with a stated step, one for each pixel of the down image: what the page shows is the value there, rounded to that step.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Picture

from phibench.benchmark.dense.dense_pairs import DensePairs
from phibench.benchmark.dense.dense_pictures import CAUSE_COLOURS, CAUSE_GROUPS, ERROR, FAR_M, NEAR_M, DensePicture
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.datasets.sample_page import MOST_CODE, base64_text, filled_page, packed, reflection_grid, scene_of
from phibench.datasets.store.files import write_text
from phibench.estimator.dense.dense_bound import dense_bound
from phibench.estimator.dense.unrolled_pair import luma_codes
from phibench.estimator.geometry.reflection import image_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

PLANE_STEPS = {
    "depth_m": 1e-3,
    "answer_m": 1e-3,
    "x_m": 1e-3,
    "y_m": 1e-3,
    "z_m": 1e-3,
    "up_u_px": 0.02,
    "up_v_px": 0.02,
    "answer_u_px": 0.02,
    "answer_v_px": 0.02,
    "sigma_m": 1e-3,
    "bound_m": 1e-3,
}
"""Step of each plane; of both sigmas the step of their natural logarithm. A plane that needs more takes twice, ..."""
LOGARITHMIC = ("sigma_m", "bound_m")
_SIGMA_M = (1e-6, 1e3)  # what is shown of sigmas; beyond lies no texture
_IN_WORDS = {
    "none": "both images show this point",
    "nothing": "no surface: beside the mirror, or the ray leaves the room",
    "robot": "the robot: it moves with the camera",
    "holder": "the mirror's holder: it moves with the camera",
    "mirror_rim": "hidden from the up image: no point of the mirror shows it there",
    "back_side": "hidden from the up image: that position looks at the back of its surface",
    "outside_image": "hidden from the up image: its place is outside",
}
_JPEG_QUALITY = 95
_COLOURS = 33  # of a scale; the page interpolates


@dataclass(frozen=True)
class DensePage:
    """Page of one answer.

    Parameters
    ----------
    pairs : DensePairs
        That the picture is of.
    """

    picture: DensePicture
    pairs: DensePairs

    @property
    def sample(self) -> Sample:
        """Sample of the pair."""
        return self.pairs.dataset[self.picture.truth.sample_id]

    def html(self) -> str:
        """Text of the page."""
        return filled_page(Path(__file__).with_suffix(".html"), "phibench dense depth", self.data())

    def write(self, path: str | Path) -> Path:
        """Write the page; return the file's path.

        Raises
        ------
        DatasetError
            If the file cannot be written.
        """
        try:
            return write_text(Path(path), self.html())
        except OSError as error:
            raise DatasetError(f"the page was not written: {error}, for example `--html dense.html`") from error

    def data(self) -> dict[str, Any]:
        """All that the page shows, as JSON holds it."""
        picture, truth, camera = self.picture, self.picture.truth, self.picture.truth.true_rig.camera
        frames = {position: base64_text(self._jpeg(position)) for position in POSITIONS}
        views: dict[str, Any] = {
            p: {"width": camera.width_px, "height": camera.height_px, "picture": frames[p]} for p in POSITIONS
        }
        views["down"] |= {"planes": self._planes(), "reflection": reflection_grid(self.sample.view("down"))}
        scene = scene_of(self.sample) | {"spot": None}
        for rig in scene["rigs"]:
            rig["chief_ray"] = []  # of a spot, which dense pairs have not
        return {
            "id": truth.sample_id,
            "dataset": self.pairs.dataset.info.name,
            "method": picture.name,
            "preset": truth.preset,
            "stroke_m": truth.stroke_m,
            "median": _median(picture.error[picture.known]),
            "answered": float(picture.known.sum() / max(int(truth.scored.sum()), 1)),
            "objects": list(self.sample.object_names),
            "causes": [_words(name) for name in self._causes()[1]],
            "groups": list(CAUSE_GROUPS),
            "views": views,
            "grid": self._grid(),
            "scales": {"depth_m": [NEAR_M, FAR_M], "error": ERROR, **_colours()},
            "scene": scene,
        }

    def _jpeg(self, position: str) -> bytes:
        """The camera's file; of other outputs their luma."""
        frame = self.pairs.frames(self.picture.truth.number)[position]
        if frame.jpeg is not None:
            return frame.jpeg
        grey = luma_codes(getattr(self.picture.pair, position), self.picture.pair.card)
        file = io.BytesIO()
        Picture.fromarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8)).save(file, "JPEG", quality=_JPEG_QUALITY)
        return file.getvalue()

    def _causes(self) -> tuple[Any, list[str]]:
        """Index of each pixel's cause, and their names."""
        codes, index = np.unique(self.picture.truth.found.cause, return_inverse=True)
        names = [self.picture.truth.found.cause_name(int(code)) for code in codes]
        return index.reshape(self.picture.depth_m.shape), names

    def values(self) -> dict[str, Array]:
        """Planes by name, shape (H, W); NaN for what is not there."""
        picture, truth = self.picture, self.picture.truth
        x, y, z = np.moveaxis(truth.found.point_world_m, -1, 0)
        points = picture.points_m(picture.depth_m)
        answered, known = np.full((*picture.depth_m.shape, 2), np.nan), np.isfinite(points[..., 0])
        answered[known] = image_of(truth.given_rig.at(truth.given_stroke_m), points[known]).uv_px
        outside = np.full(known.shape, np.nan)
        return {
            "depth_m": truth.depth_m,
            "answer_m": picture.depth_m,
            "x_m": x,
            "y_m": y,
            "z_m": z,
            "up_u_px": truth.found.uv_px[..., 0],
            "up_v_px": truth.found.uv_px[..., 1],
            "answer_u_px": answered[..., 0],
            "answer_v_px": answered[..., 1],
            "sigma_m": outside if picture.sigma_depth_m is None else picture.sigma_depth_m,
            "bound_m": np.where(truth.scored, self._bound_m(), np.nan),
        }

    def _bound_m(self) -> Array:
        truth, card = self.picture.truth, self.picture.pair.card
        planes = self.sample.ambient("down").astype(float) * card.exposure_s
        return dense_bound(truth.true_rig, truth.stroke_m, card, planes, truth.depth_m)

    def _planes(self) -> dict[str, dict[str, Any]]:
        object_id = np.asarray(self.sample.truth("down")["object_id"])
        whole = {"object_id": object_id, "cause": self._causes()[0], "group": self.picture.groups}
        planes = {
            name: {"step": 1, "offset": 0, "data": packed(np.where(plane < 0, MOST_CODE + 1, plane))}
            for name, plane in whole.items()
        }
        return planes | {name: _coded(name, plane) for name, plane in self.values().items()}

    def _grid(self) -> dict[str, Any]:
        """Nearest pixel of each point of the panoramas."""
        grid, camera = self.picture.maps.grid, self.picture.truth.true_rig.camera
        places = np.rint(self.picture.maps.down_px)
        u, v = np.clip(places[..., 0], 0, camera.width_px - 1), np.clip(places[..., 1], 0, camera.height_px - 1)
        high = float(np.degrees(grid.high_rad))
        return {
            "width": grid.width_px,
            "height": grid.height_px,
            "elevations_deg": [round(high - grid.height_px * float(np.degrees(grid.step_rad)), 2), round(high, 2)],
            "u": packed(u),
            "v": packed(v),
        }


def _words(cause: str) -> str:
    thing = cause.removeprefix("occluded:")
    return _IN_WORDS[cause] if thing == cause else f"hidden from the up image: {thing} is in the way"


def _median(error: Array) -> float | None:
    return float(np.median(np.abs(error))) if len(error) else None


def _coded(name: str, values: Array) -> dict[str, Any]:
    """Plane as 16-bit codes; 65535 is NaN."""
    log = name in LOGARITHMIC
    known = np.isfinite(values)
    shown = np.where(known, values, 1.0)
    shown = np.log(np.clip(shown, *_SIGMA_M)) if log else shown
    step, inside = PLANE_STEPS[name], shown[known]
    low, high = (float(inside.min()), float(inside.max())) if len(inside) else (0.0, 0.0)
    while high - low > step * (MOST_CODE - 1):
        step *= 2.0
    offset = step * float(np.floor(low / step))
    codes = np.where(known, np.rint((shown - offset) / step), MOST_CODE + 1)
    return {"step": step, "offset": offset, "data": packed(codes)} | ({"log": 1} if log else {})


def _colours() -> dict[str, Any]:
    """Colours of the pictures, 8-bit: of D and of its error along their scales, and of the causes."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    def along(name: str) -> list[list[int]]:
        return np.rint(255.0 * colormaps[name](np.linspace(0.0, 1.0, _COLOURS))[:, :3]).astype(int).tolist()

    causes = [[round(255.0 * c) for c in to_rgb(colour)] for colour in CAUSE_COLOURS]
    return {"of_depth": along("viridis"), "of_error": along("RdBu"), "of_causes": causes}
