"""Pictures of a method's dense answer: panoramas of image, D, error and causes; the room from above with free space.

The panoramas are unrolled as those of the methods, pixel by pixel without mixing: a column is an azimuth, a row an
elevation. From above, what a robot may drive on ends at the nearest point that stands between its wheels and its top.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from phibench.benchmark.dense.dense_pairs import DensePairs, DenseTruth
from phibench.benchmark.dense.dense_records import depths_of
from phibench.benchmark.isolation.method_references import DENSE, resolve
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness
from phibench.benchmark.reports.figures import encoded_figure, styled_figure
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import place_of
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.dense.unrolled_pair import PanoramaMaps, luma_codes, maps_of
from phibench.estimator.geometry.epipolar_line import range_at
from phibench.estimator.geometry.reflection import room_rays
from phibench.scenes.frames import Array, BoolArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH_PX = 720  # of the panoramas: half a degree
ERROR = 0.1
"""Relative error at the ends of the colours."""
NEAR_M, FAR_M = 0.4, 10.0
"""D at the ends of the colours."""
OBSTACLE_M = (0.05, 1.0)
"""Heights between which a thing is in a robot's way."""
_SECTORS = 180  # of two degrees
_SECTOR_PART = 0.02  # of a sector's points that may be nearer than its free space: lone errors
_SECTOR_POINTS = 5  # fewer say nothing
_RANGE_M = 6.0  # of the map
CAUSE_GROUPS = ("seen in both", "hidden by a thing", "rim, back or outside", "robot or holder", "nothing")
_GROUP_OF = {"robot": 3, "holder": 3, "nothing": 4}
CAUSE_COLOURS = ("#d9d9d9", "#d55e00", "#e69f00", "#0072b2", "#000000")


@dataclass(frozen=True)
class DensePicture:
    """One answer beside its truth.

    Parameters
    ----------
    depth_m : array, shape (H, W)
        The answer's D.
    name : str
        Of the method.
    sigma_depth_m : array, shape (H, W), or None
        Of the answer, if the method has one.
    """

    pair: DensePair
    truth: DenseTruth
    depth_m: Array
    name: str
    sigma_depth_m: Array | None = None

    @cached_property
    def error(self) -> Array:
        """Relative error of D, shape (H, W)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.depth_m / self.truth.depth_m - 1.0)

    @cached_property
    def known(self) -> BoolArray:
        """Mask of the answered pixels whose room point both images show."""
        return np.asarray(np.isfinite(self.error) & self.truth.scored)

    @cached_property
    def maps(self) -> PanoramaMaps:
        """Grid of the panoramas, by the rig that was rendered."""
        return maps_of(self.truth.true_rig, self.truth.stroke_m, _WIDTH_PX)

    def unrolled(self, plane: NDArray[Any]) -> NDArray[Any]:
        """Values of the nearest pixels on the panorama's grid."""
        camera = self.truth.true_rig.camera
        places = np.rint(self.maps.down_px).astype(int)
        u, v = np.clip(places[..., 0], 0, camera.width_px - 1), np.clip(places[..., 1], 0, camera.height_px - 1)
        return plane[v, u]

    @property
    def groups(self) -> NDArray[np.int64]:
        """Index into `CAUSE_GROUPS` of each pixel, shape (H, W)."""
        found, groups = self.truth.found, np.full(self.depth_m.shape, 2)
        for code in np.unique(found.cause).tolist():
            name = found.cause_name(code)
            groups[found.cause == code] = _GROUP_OF.get(name, 1 if name.startswith("occluded:") else 2)
        groups[self.truth.scored] = 0
        return groups

    def panoramas_png(self) -> bytes:
        """Panoramas of the image, the answer, its error and the causes, one below the other."""
        from matplotlib.colors import ListedColormap, LogNorm

        error, known = self.error, self.known
        grey = luma_codes(self.pair.down, self.pair.card)
        with styled_figure({"axes.grid": False}, (8.0, 10.4), layout="constrained") as figure:
            axes = figure.subplots(4, 1)
            share = known.sum() / max(int(self.truth.scored.sum()), 1)
            self._panel(axes[0], grey, "down image, laser off", cmap="gray")
            shown = self._panel(
                axes[1],
                self.depth_m,
                f"D by {self.name}: {share:.0%} answered; white is unknown",
                cmap="viridis",
                norm=LogNorm(NEAR_M, FAR_M),
            )
            bar = figure.colorbar(shown, ax=axes[1], label="D, m", ticks=[0.5, 1, 2, 5, 10], format="{x:g}")
            bar.ax.minorticks_off()
            median = float(np.median(np.abs(error[known]))) if known.any() else float("nan")
            title = f"error of D where both images show the point: median {100.0 * median:.2f} %"
            shown = self._panel(
                axes[2], np.where(known, 100.0 * error, np.nan), title, cmap="RdBu", vmin=-100 * ERROR, vmax=100 * ERROR
            )
            figure.colorbar(shown, ax=axes[2], label="%, blue is too far", extend="both")
            colours = ListedColormap(list(CAUSE_COLOURS))
            shown = self._panel(
                axes[3], self.groups, "where the up image shows the same point", cmap=colours, vmin=-0.5, vmax=4.5
            )
            bar = figure.colorbar(shown, ax=axes[3], ticks=range(len(CAUSE_GROUPS)))
            bar.ax.set_yticklabels(CAUSE_GROUPS)
            return encoded_figure(figure, "png")

    def _panel(self, axes: Axes, plane: NDArray[Any], title: str, **options: Any) -> Any:
        grid = self.maps.grid
        low, high = np.degrees(grid.high_rad - grid.height_px * grid.step_rad), np.degrees(grid.high_rad)
        axes.set_title(title)
        axes.set_xticks(range(-180, 181, 90))
        axes.set_yticks(range(-60, 61, 30))
        axes.set_ylabel("elevation, deg")
        extent = (180.0, -180.0, float(low), float(high))
        return axes.imshow(self.unrolled(plane), extent=extent, interpolation="nearest", **options)

    def from_above_png(self) -> bytes:
        """Room from above: points of the answer in a robot's way by their error, and free space of answer and truth."""
        given, true = self._obstacles(self.depth_m), self._obstacles(self.truth.depth_m)
        with styled_figure({}, (7.0, 6.2), layout="constrained") as figure:
            axes = figure.add_subplot()
            axes.plot(*_closed(free_space(true)), color="black", linewidth=1.0, label="free space, true")
            axes.fill(
                *_closed(free_space(given)),
                color="#009e73",
                alpha=0.25,
                linewidth=0.0,
                label=f"free space by {self.name}",
            )
            at = self._obstacle_mask(self.depth_m)
            error = 100.0 * self.error[at]
            points = axes.scatter(
                given[:, 0], given[:, 1], c=error, s=0.4, cmap="RdBu", vmin=-100 * ERROR, vmax=100 * ERROR
            )
            points.set_rasterized(True)
            figure.colorbar(points, ax=axes, label="error of D, %, blue is too far", extend="both")
            axes.plot(0.0, 0.0, marker="o", color="#0072b2", markersize=7, linestyle="none", label="robot")
            low, high = OBSTACLE_M
            axes.set_title(f"what stands {low:g} to {high:g} m above the floor")
            axes.set(
                xlim=(-_RANGE_M, _RANGE_M), ylim=(-_RANGE_M, _RANGE_M), xlabel="x, m", ylabel="y, m", aspect="equal"
            )
            axes.legend(loc="upper right", fontsize=8.0)
            return encoded_figure(figure, "png")

    def points_m(self, depth_m: Array) -> Array:
        """Room points of the pixels at a D, shape (H, W, 3), world, as the given rig sees them."""
        view = self.truth.given_rig.at(0.0)
        height, width = depth_m.shape
        uv = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
        points = np.full((height, width, 3), np.nan)
        known = np.isfinite(depth_m)
        ray = room_rays(view, uv[known])
        t = range_at(ray.origin_world_m - view.sphere_centre_m, ray.direction_world, depth_m[known])
        points[known] = ray.origin_world_m + t[:, None] * ray.direction_world
        return points

    def _obstacle_mask(self, depth_m: Array) -> BoolArray:
        """Pixels of the room whose point, at a D, stands in a robot's way."""
        with np.errstate(invalid="ignore"):
            z = self.points_m(depth_m)[..., 2]
            return np.asarray((z > OBSTACLE_M[0]) & (z < OBSTACLE_M[1]) & self.truth.found.of_room)

    def _obstacles(self, depth_m: Array) -> Array:
        """Their x and y from the axis, shape (n, 2)."""
        centre = self.truth.given_rig.at(0.0).sphere_centre_m
        return np.asarray((self.points_m(depth_m) - centre)[self._obstacle_mask(depth_m)][:, :2])


def picture_of(
    reference: str, pairs: DensePairs, sample: str | None = None, limits: RunLimits | None = None
) -> DensePicture:
    """Ask a method for one pair, in a process of its own, and put its answer beside the truth.

    Parameters
    ----------
    reference : as for `run_dense`
    sample : str, optional
        Id or number of a sample; the first by default.
    limits : RunLimits, optional

    Raises
    ------
    DatasetError
        If there is no such sample, or the method gives no answer.
    MethodError
        If the method cannot be found or imported.
    """
    drawn = [draw.sample_id for draw in pairs.pair_draws]
    ids = [row.sample_id for row in pairs.dataset.rows]
    wanted = drawn[0] if sample is None else ids[place_of(sample, ids, pairs.dataset.folder)]
    if wanted not in drawn:
        raise DatasetError(f"sample {wanted} has no dense pair in these frames; take another one")
    number = drawn.index(wanted)
    with Harness([resolve(reference, DENSE)], limits, 1, pairs.folders) as harness:
        ((outcome,),) = harness.outcomes(pairs, [number])
    if outcome.dense is None:
        raise DatasetError(f"{reference} gave no answer for {wanted}: {outcome.failure}: {outcome.message}")
    truth = pairs.truth(number)
    depth_m = depths_of(outcome.dense, truth.given_rig, truth.given_stroke_m)
    sigma = outcome.dense.sigma_depth_m
    return DensePicture(
        pairs.pair(number),
        truth,
        depth_m,
        reference.rsplit("/", 1)[-1],
        None if sigma is None else np.asarray(sigma, float),
    )


def free_space(points_m: Array) -> Array:
    """Radius of the free space in each sector, shape (180,), from points (n, 2) in the way; NaN where nothing is known.

    The nearest two per cent of a sector's points do not count: lone errors would leave no room to drive.
    """
    sector = np.floor(np.arctan2(points_m[:, 1], points_m[:, 0]) / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    distance = np.hypot(points_m[:, 0], points_m[:, 1])
    radius = np.full(_SECTORS, np.nan)
    for k in range(_SECTORS):
        inside = distance[sector == k]
        if len(inside) >= _SECTOR_POINTS:
            radius[k] = np.quantile(inside, _SECTOR_PART)
    return radius


def _closed(radius_m: Array) -> tuple[Array, Array]:
    """Outline of the free space; sectors without points end at the axis."""
    edges = 2.0 * np.pi * np.arange(_SECTORS + 1) / _SECTORS
    turn = np.repeat(edges, 2)[1:-1]
    r = np.repeat(np.nan_to_num(radius_m), 2)
    return np.append(r * np.cos(turn), r[0]), np.append(r * np.sin(turn), 0.0)
