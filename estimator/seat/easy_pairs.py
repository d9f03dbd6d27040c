"""A small set of easy pairs, made in NumPy without rendering: bright spots on a smooth room, seen by an aligned rig.

For trying a method, not for ranking it: no lamp, no stripe, no shadow, and the rig is what the method believes it is.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cache
from typing import Any

import numpy as np

from phibench.datasets.sensor_card import sensor_card
from phibench.estimator.bench.truth import PairTruth, SpotTruth
from phibench.estimator.limits import spot_limit
from phibench.estimator.methods.linear import KINDS
from phibench.estimator.methods.window import clipped
from phibench.estimator.seat.easy_image import EasyCamera
from phibench.estimator.seat.easy_scene import EasyScene, EasySpot, easy_rig, easy_scene
from phibench.estimator.seat.errors import MethodError
from phibench.estimator.seat.pair import Box, Pair
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig
from phibench.scenes.streams import generator

BOX_PX = 64
_SPAN_PX = 20  # by which a box may be off the spot


@dataclass(frozen=True)
class EasyPairs:
    """Easy pairs by number; a `PairSet`.

    Parameters
    ----------
    preset : "bayer-raw", "mono-raw", "srgb8" or "mjpeg"
    count : int
    rig : Rig
        Its whole mirror should be in the image.
    laser_off, hinted : bool
        Whether pairs come with frames with the laser off, and with boxes.

    Raises
    ------
    MethodError
        If there is no such preset.
    """

    preset: str = "bayer-raw"
    count: int = 10
    rig: Rig = field(default_factory=easy_rig)
    laser_off: bool = True
    hinted: bool = True

    def __post_init__(self) -> None:
        if self.preset not in KINDS:
            raise MethodError(f"no easy pairs for preset '{self.preset}': {nearest(self.preset, KINDS)}")

    def __len__(self) -> int:
        """How many."""
        return self.count

    def pair(self, number: int) -> Pair:
        """What a method sees."""
        scene, camera = _scene(self.rig, number), self._camera()
        images: dict[str, Any] = {
            f"{name}{'' if on else '_off'}": camera.image(
                spot if on else None, scene.flux_e, (self.preset, number, name, int(on))
            )
            for on in ((True, False) if self.laser_off else (True,))
            for name, spot in (("down", scene.down), ("up", scene.up))
        }
        down, up = self.boxes(number)
        stroke, card = scene.stroke_m, camera.card
        return Pair(number, rig=self.rig, stroke_m=stroke, card=card, box_down=down, box_up=up, **images)

    def boxes(self, number: int) -> tuple[Box | None, Box | None]:
        """Region hints of a pair."""
        if not self.hinted:
            return None, None
        scene = _scene(self.rig, number)
        return self._box(number, "down", scene.down), self._box(number, "up", scene.up)

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        scene, camera = _scene(self.rig, number), self._camera()
        down, up = (_spot_truth(camera, scene, spot) for _, spot in _spots(scene))
        quality = camera.card.jpeg_quality if self.preset == "mjpeg" else None
        return PairTruth(
            number,
            f"easy-{number}",
            0,
            self.preset,
            quality,
            self.hinted,
            scene.depth_m,
            scene.stroke_m,
            self.rig,
            self.rig,
            down,
            up,
        )

    def document(self) -> dict[str, Any]:
        """Provenance."""
        return {"name": "easy pairs", "preset": self.preset, "pairs": self.count, "rig": asdict(self.rig)}

    def _camera(self) -> EasyCamera:
        return EasyCamera(self.rig.camera, sensor_card(self.preset))

    def _box(self, number: int, name: str, spot: EasySpot) -> Box:
        shift = generator("easy pairs", "box", number, name).integers(-_SPAN_PX, _SPAN_PX, 2, endpoint=True)
        u, v = (round(x) + int(d) - BOX_PX // 2 for x, d in zip(spot.uv_px, shift, strict=True))
        return clipped(Box(u, v, BOX_PX, BOX_PX), (self.rig.camera.height_px, self.rig.camera.width_px))


def _spots(scene: EasyScene) -> tuple[tuple[str, EasySpot], ...]:
    return ("down", scene.down), ("up", scene.up)


@cache
def _scene(rig: Rig, number: int) -> EasyScene:
    return easy_scene(rig, number)


def _spot_truth(camera: EasyCamera, scene: EasyScene, spot: EasySpot) -> SpotTruth:
    region, card = camera.expected(spot, scene.flux_e), camera.card
    limit = spot_limit(region, card)
    bound = limit.covariance_px2
    peak = float(region.mean_e.max())
    return SpotTruth(
        spot.uv_px,
        spot.phi_rad,
        spot.azimuth_rad,
        True,
        "none",
        float(region.spot_e.sum()),
        peak,
        float(region.spot_e.sum() / np.sqrt(region.mean_e[region.spot_e > 0.01 * region.spot_e.max()].sum())),
        peak > card.saturation_e,
        bound if card.output == "raw" else None,
        bound,
    )
