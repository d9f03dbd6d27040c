"""Check of samples by Mitsuba's path tracer (`check_sample`): ambient light, mirror outline and spot against ours.

Nothing of phibench's optics, light maps or Dr.Jit kernels takes part: the XML holds standard plugins alone. Compared
are

* **ambient light**: means over squares that tile the image, in the mirror, and beside it. The image of Mitsuba gets our
  lens's blur. A square shows no lamp, and counted are pixels that show nothing of the robot, and nothing nearer than
  `NEAREST_M`: what light maps leave out there (docs/model.md) is known. The noise is that of the mean, from the scatter
  of the squares: it holds the noise of both renderers. A light map's is the larger one, and the same within a
  decimetre: many squares with few paths each see more than few with many.
* **outline**: the mirror's share of windows around places of it, as a distance across the outline.
* **spot**: flux and centroid of its light on a film sixteen times as fine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.datasets.read import Dataset, Sample
from phibench.datasets.scene.scene_export import expected_radiance, in_exported_pixels, sample_scene, write_scene
from phibench.render.plugins.standard_scene import Light, etendue, exported_camera, film_axes
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import seed_32
from phibench.scenes.rig import POSITIONS
from phibench.scenes.validation import SceneError

LIGHT_TOLERANCE = 0.005
"""Of means of ambient light, and of the spot's flux, beside three standard errors."""
CENTROID_TOLERANCE_PX, OUTLINE_TOLERANCE_PX = 0.02, 0.02  # beside three standard errors
SIGMAS = 3.0  # of the path tracer's noise
NEAREST_M = 0.5
_SIDES = {"in the mirror": 11.0, "beside it": 5.5}  # height of the image over the side of a square, independent ones
_SAMPLES = 16  # of a pixel of the ambient image; with 4 the sampler has 3 % too much of the lab's ceiling
_EVEN = 4.0  # brightest pixel of a square over its median: no lamp
_AROUND, _OUTLINE_SIDE_PX, _FINEST = 8, 8, 16
_FINER, _SPOT_RUNS, _SPOT_SAMPLES = 16, 8, 1 << 20
Crop = tuple[int, int, int, int]


@dataclass(frozen=True)
class RendererDifference:
    """Mitsuba less phibench, and its standard error."""

    value: float
    error: float
    tolerance: float
    unit: str

    @property
    def fault(self) -> bool:
        """True beyond tolerance and three standard errors."""
        return not abs(self.value) <= self.tolerance + SIGMAS * self.error

    def __str__(self) -> str:
        scale, digits, unit = (100.0, 2, " %") if self.unit == "1" else (1.0, 4, " px")
        return f"{scale * self.value:+.{digits}f}{unit} +- {scale * self.error:.{digits}f}"


@dataclass(frozen=True)
class ViewComparison:
    """One view of a sample.

    Attributes
    ----------
    differences : dict of str to RendererDifference
    left_out : tuple of str
        What was not compared, and why.
    """

    sample_id: str
    position: str
    differences: dict[str, RendererDifference]
    left_out: tuple[str, ...]

    @property
    def faults(self) -> list[str]:
        """One sentence for each difference beyond its tolerance."""
        return [
            f"{self.sample_id} {self.position}: {name} of Mitsuba's path tracer differs by {found}"
            for name, found in self.differences.items()
            if found.fault
        ]

    def __str__(self) -> str:
        parts = [*(f"{name} {found}" for name, found in self.differences.items()), *self.left_out]
        return f"{self.sample_id} {self.position}: {'; '.join(parts)}"


def chosen_samples(dataset: Dataset, count: int) -> list[Sample]:
    """So many samples, spread evenly over a data set."""
    places = np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).round().astype(int))
    return [dataset[int(place)] for place in places]


def check_sample(sample: Sample) -> Iterator[ViewComparison]:
    """Compare both views of a sample."""
    for position in POSITIONS:
        yield check_view(sample, position)


def check_view(sample: Sample, position: str) -> ViewComparison:
    """Compare one view of a sample."""
    differences: dict[str, RendererDifference] = {}
    left_out: list[str] = []
    view, room = sample.view(position), sample.room
    try:
        with tempfile.TemporaryDirectory() as folder:
            if view.tube is not None:
                left_out.append("not compared: our layers leave out reflections in the tube's glass")
            else:
                scene = LoadedScene(sample, position, Path(folder))
                differences["outline"] = _outline(scene)
                if room.sun is not None:
                    left_out.append("ambient light not compared: standard plugins have no sun behind panes")
                else:
                    differences |= _ambient(scene)
                differences |= _spot(scene)
    except SceneError as error:
        left_out.append(f"not compared: {error}")
    return ViewComparison(sample.row.sample_id, position, differences, tuple(left_out))


class LoadedScene:
    """Scenes of a view as Mitsuba loads them from XML."""

    def __init__(self, sample: Sample, position: str, folder: Path) -> None:
        self.sample, self.position, self.folder = sample, position, folder
        self.camera = exported_camera(sample.rig.camera)
        self.mi = activate()
        self._scenes: dict[str, Any] = {}

    def scene(self, light: Light) -> Any:
        """Scene of a light, loaded once."""
        if light not in self._scenes:
            tree = sample_scene(self.sample, self.position, light)
            path = write_scene(self.folder / f"{light}.xml", tree)
            self._scenes[light] = self.mi.load_file(str(path), parallel=False, optimize=False)
        return self._scenes[light]

    def rendered(
        self, light: Light, crop: Crop, samples: int, seed: int, finer: int = 1, integrator: Any = None
    ) -> Array:
        """Radiance in a window, shape (h, w, 3), on a film that is so many times as fine; the crop is in its pixels.

        An integrator may take the place of the scene's.
        """
        mi, scene = self.mi, self.scene(light)
        sensor = scene.sensors()[0]
        values = mi.traverse(sensor)
        x, y = film_axes(self.camera)
        values["film.size"] = [finer * x.size, finer * y.size]
        values["film.crop_offset"] = [int(finer * x.offset + crop[0]), int(finer * y.offset + crop[1])]
        values["film.crop_size"] = [int(length) for length in crop[2:]]
        values.update()
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed), dtype=float)


# Ambient light.


def _ambient(scene: LoadedScene) -> dict[str, RendererDifference]:
    ours = light_layer(scene.sample, scene.position)
    if not ours.any():
        return {}  # a dark room
    height, width = ours.shape[:2]
    seed, sigma = seed_32("mitsuba", scene.sample.row.sample_id, scene.position), scene.camera.blur_sigma_px
    theirs = ndimage.gaussian_filter(
        scene.rendered("ambient", (0, 0, width, height), _SAMPLES, seed), (sigma, sigma, 0.0)
    )
    differences = {}
    for name, free in _free(scene, ours).items():
        wide = ndimage.minimum_filter(free, 2 * int(np.ceil(4.0 * sigma)) + 1, mode="constant", cval=False)
        ratios = np.array(list(_ratios(theirs, ours, wide, round(height / _SIDES[name])))) - 1.0
        if len(ratios) > 1:
            error = ratios.std(ddof=1) / np.sqrt(len(ratios))
            differences[f"light {name}"] = RendererDifference(float(ratios.mean()), float(error), LIGHT_TOLERANCE, "1")
    return differences


def light_layer(sample: Sample, position: str) -> Array:
    """Our ambient light in the pixels of the exported scene, shape (H, W, 3), W/(m^2 sr)."""
    return np.moveaxis(expected_radiance(sample, position, "ambient"), 0, -1)


def _ratios(theirs: Array, ours: Array, free: NDArray[np.bool_], side: int) -> Iterator[float]:
    """Mitsuba's mean over ours, of all bands, in each evenly lit square of which half is free."""
    for v in range(0, ours.shape[0] - side + 1, side):
        for u in range(0, ours.shape[1] - side + 1, side):
            square = slice(v, v + side), slice(u, u + side)
            pixels = ours[square][free[square]]
            level = pixels.mean(axis=-1)
            if 2 * len(pixels) >= side**2 and 0.0 < level.max() <= _EVEN * np.median(level):
                yield float((theirs[square][free[square]].mean(axis=0) / pixels.mean(axis=0)).mean())


def _free(scene: LoadedScene, ours: Array) -> dict[str, NDArray[np.bool_]]:
    """Pixels that may be compared, in the mirror and beside it, shape (H, W)."""
    sample, view = scene.sample, scene.sample.view(scene.position)
    truth = sample.truth(scene.position)
    ids, depth_m = (in_exported_pixels(sample.rig.camera, truth[name], order=0) for name in ("object_id", "depth_m"))
    own = len(sample.room.surfaces) + len(sample.room.furniture)
    with np.errstate(invalid="ignore"):
        shown = (ids >= 0) & (ids < own) & (depth_m > NEAREST_M)
    outline = scene.camera.project(sample.rig.camera.rays(sample.rig.outline_px()))
    middle = outline.mean(axis=0)
    reach = float(np.linalg.norm(outline - middle, axis=1).max())
    v, u = np.mgrid[: ours.shape[0], : ours.shape[1]]
    beside = np.hypot(u - middle[0], v - middle[1]) > reach
    seen = np.isfinite(ours).all(axis=-1)
    return {"in the mirror": shown & seen, "beside it": beside & seen & (not view.holder_shapes)}


# Outline.

_DENSE = 14400  # places of the outline, 0.15 px apart for the default rig


def _outline(scene: LoadedScene) -> RendererDifference:
    """Mean distance of Mitsuba's outline beyond ours, over places around it."""
    rig = scene.sample.rig
    outline = scene.camera.project(rig.camera.rays(rig.outline_px(_DENSE)))
    inner, side = outline.mean(axis=0), _OUTLINE_SIDE_PX
    mirror = _shape_index(scene, (*np.floor(inner).astype(int), 1, 1))[0, 0]
    offsets = []
    for place in range(0, _DENSE, _DENSE // _AROUND):
        around = np.roll(outline, -place, axis=0)
        u, v = np.floor(around[0] + 0.5).astype(int) - side // 2
        if 0 <= u <= rig.camera.width_px - side and 0 <= v <= rig.camera.height_px - side:
            index = _shape_index(scene, (_FINEST * u, _FINEST * v, _FINEST * side, _FINEST * side), _FINEST)
            offsets.append(_offset_px(around, inner, (u, v, side, side), float((index == mirror).mean())))
    if len(offsets) < 2:
        return RendererDifference(0.0, float("inf"), OUTLINE_TOLERANCE_PX, "px")
    return RendererDifference(
        float(np.mean(offsets)), float(np.std(offsets, ddof=1) / np.sqrt(len(offsets))), OUTLINE_TOLERANCE_PX, "px"
    )


def _shape_index(scene: LoadedScene, crop: Crop, finer: int = 1) -> Array:
    """Number of the shape that one ray of each pixel meets, shape (h, w)."""
    integrator = scene.mi.load_dict({"type": "aov", "aovs": "shape:shape_index"})
    return scene.rendered("ambient", crop, 1, 0, finer, integrator)[..., -1]


def _offset_px(outline: Array, inner: Array, crop: Crop, share: float) -> float:
    """Distance by which a mirror with this share of a window reaches beyond our outline, whose first point is in it."""
    u, v, side, _ = crop
    steps = (np.arange(_FINEST * side) + 0.5) / _FINEST - 0.5
    places = np.stack(np.meshgrid(u + steps, v + steps), axis=-1)
    tangent = outline[1] - outline[-1]
    tangent /= np.linalg.norm(tangent)
    outward = np.array([-tangent[1], tangent[0]])
    outward *= np.sign(outward @ (outline[0] - inner))
    near = outline[np.linalg.norm(outline - outline[0], axis=1) < 2.0 * side]
    along, out = (near - outline[0]) @ tangent, (near - outline[0]) @ outward
    order = np.argsort(along)
    at, height = (places - outline[0]) @ tangent, (places - outline[0]) @ outward
    ours = float((height < np.interp(at, along[order], out[order])).mean())
    inside = np.all((outline > [u - 0.5, v - 0.5]) & (outline < [u + side - 0.5, v + side - 0.5]), axis=1)
    length = np.linalg.norm(np.diff(outline, axis=0, append=outline[:1]), axis=1)[inside].sum()
    return (share - ours) * side * side / float(length)


# The spot.


def _spot(scene: LoadedScene) -> dict[str, RendererDifference]:
    """Flux and centroid of the spot's light, where all of it falls on the image."""
    sample, camera = scene.sample, scene.camera
    row = sample.truth_row(scene.position)
    if not row.visible or row.light is None:
        return {}  # no spot to compare
    u, v = camera.project(sample.rig.camera.rays(np.array([row.light.u_px, row.light.v_px])))
    half = int(np.ceil(_FINER * _half_px(scene)))
    low = np.floor(_FINER * (np.array([u, v]) + 0.5)).astype(int) - half
    side = 2 * half + 1
    if low.min() < 0 or np.any(low + side > _FINER * np.array([camera.width_px, camera.height_px])):
        return {}  # the window leaves the image
    crop = (int(low[0]), int(low[1]), side, side)
    samples = max(1, round(np.sqrt(_SPOT_SAMPLES / side**2))) ** 2
    middle = (np.arange(side) + 0.5) / _FINER - 0.5
    places = np.stack(np.meshgrid(low[0] / _FINER + middle, low[1] / _FINER + middle), axis=-1)
    watts = etendue(camera, places)[..., 0] / _FINER**2
    seeds = [seed_32("mitsuba spot", sample.row.sample_id, scene.position, k) for k in range(_SPOT_RUNS)]
    runs = np.array([scene.rendered("spot", crop, samples, seed, _FINER)[..., 0] * watts for seed in seeds])
    flux = runs.sum(axis=(1, 2))
    centres = np.einsum("nij,ijk->nk", runs, places) / flux[:, None]
    pixels = sample.rig.camera.project(camera.rays(centres))
    apart = pixels - [row.light.u_px, row.light.v_px]
    mean, error = apart.mean(axis=0), apart.std(axis=0, ddof=1) / np.sqrt(len(runs))
    ratio = flux / row.electrons_per_s[0]
    return {
        "flux of the spot": RendererDifference(
            float(ratio.mean() - 1.0), float(ratio.std(ddof=1) / np.sqrt(len(runs))), LIGHT_TOLERANCE, "1"
        ),
        "centroid of the spot": RendererDifference(
            float(np.linalg.norm(mean)), float(np.linalg.norm(error)), CENTROID_TOLERANCE_PX, "px"
        ),
    }


def _half_px(scene: LoadedScene) -> float:
    """Half of a window that holds the spot's light without blur: by the spread of the layer's, less the blur's."""
    layer = scene.sample.spot(scene.position).electrons_per_s[0]
    rows, columns = layer.sum(axis=1), layer.sum(axis=0)
    spread = max(_variance(rows), _variance(columns)) - scene.camera.blur_sigma_px**2 - 1.0 / 12.0  # and a pixel's own
    return _LEAST_PX + _SPREADS * float(np.sqrt(max(spread, 0.0)))


_LEAST_PX, _SPREADS = 0.5, 6.0  # six sigma of a Gaussian spot hold all but 1e-8 of its light


def _variance(weights: Array) -> float:
    places = np.arange(len(weights))
    mean = np.average(places, weights=weights)
    return float(np.average((places - mean) ** 2, weights=weights))
