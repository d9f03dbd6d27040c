"""One spot in one view: exact answer, layer, certificate. Needs NumPy only."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.layers import SpotWindow, write_spot
from phibench.datasets.plan import PairPlan, Plan
from phibench.datasets.schema import CertificateRow, ManifestRow, SpotRow
from phibench.render.certificate import Certificate, certify
from phibench.render.spot import SpotLayer, spot_layer
from phibench.render.spot_truth import SpotTruth, depth_m, spot_truth
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, View
from phibench.scenes.room import Room


@dataclass(frozen=True)
class SpotAnswer:
    """Everything about one spot in one view; `certificate` is None where the spot is not visible."""

    truth: SpotTruth
    layer: SpotLayer
    certificate: Certificate | None
    on_image: bool

    @property
    def coma_shift_px(self) -> tuple[float, float]:
        """Energy centroid minus chief ray, pixels (u, v)."""
        u_px, v_px = self.layer.centroid_uv_px
        return float(u_px) - self.truth.u_px, float(v_px) - self.truth.v_px


class RefusedSampleError(DatasetError):
    """A sample whose certificate is out of tolerance."""


def answer_spot(view: View, spot: LaserSpot, room: Room) -> SpotAnswer:
    """Compute one spot in one view."""
    shapes = room.shapes(view)
    truth, layer = spot_truth(view, spot, shapes), spot_layer(view, spot, shapes)
    certificate = certify(view, spot, shapes, truth, layer) if truth.visible else None
    return SpotAnswer(truth, layer, certificate, _reaches(view, _window(layer)))


def make_rows(plan: Plan, out: Path, advance: Callable[[], None] = lambda: None) -> list[ManifestRow]:
    """Compute all spots of a plan, write their layers below `out`, return the manifest's rows.

    A spot that several pairs see from one pose is computed once.

    Raises
    ------
    RefusedSampleError
        If a certificate is out of tolerance, with its numbers, for all such samples in one go.
    """
    answers: dict[tuple[str, float], SpotAnswer] = {}
    refused, rows = [], []
    for pair in plan.pairs:
        for position in POSITIONS:
            view = plan.view(pair, position)
            key = (pair.target, view.offset_m)
            if key not in answers:
                answers[key] = answer_spot(view, plan.spots[pair.target], plan.room)
            refused += _complaints(pair, position, answers[key])
        if not refused:
            rows.append(_write_pair(plan, pair, answers, out))
        advance()
    if refused:
        raise RefusedSampleError("\n".join(["refused, a certificate is out of tolerance:", *refused]))
    return rows


def _write_pair(plan: Plan, pair: PairPlan, answers: dict[tuple[str, float], SpotAnswer], out: Path) -> ManifestRow:
    spots = {}
    for position in POSITIONS:
        view = plan.view(pair, position)
        answer = answers[pair.target, view.offset_m]
        file = layout.spot_file(pair.sample_id, position) if answer.on_image else None
        if file is not None:
            header = {"dataset": plan.recipe.dataset.name, "sample_id": pair.sample_id, "position": position}
            write_spot(out / file, _window(answer.layer), header)
        spots[position] = _spot_row(pair.pose_id(position), view, answer, file)
    return manifest_row(plan, pair, spots["down"], spots["up"])


def manifest_row(plan: Plan, pair: PairPlan, down: SpotRow, up: SpotRow) -> ManifestRow:
    """One row of the manifest."""
    spot = plan.spots[pair.target]
    return ManifestRow(
        sample_id=pair.sample_id,
        experiment=pair.experiment,
        target=pair.target,
        depth_m=float(depth_m(np.array(spot.position_world_m), plan.rig.at(0.0).sphere_centre_m)),
        stroke_m=pair.stroke_m,
        spot_world_m=_triple(spot.position_world_m),
        spot_normal_world=_triple(spot.normal_world),
        spot_diameter_m=spot.diameter_m,
        down=down,
        up=up,
    )


def _spot_row(pose_id: str, view: View, answer: SpotAnswer, file: str | None) -> SpotRow:
    certificate = answer.certificate
    return SpotRow(
        pose=pose_id,
        offset_m=view.offset_m,
        **asdict(answer.truth),
        coma_shift_px=answer.coma_shift_px,
        electrons_per_s=_triple(answer.layer.total_electrons_per_s),
        view_ambient_file=layout.view_file(pose_id, "ambient"),
        view_truth_file=layout.view_file(pose_id, "truth"),
        spot_file=file,
        certificate=None if certificate is None else CertificateRow(**asdict(certificate)),
    )


def _triple(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _complaints(pair: PairPlan, position: str, answer: SpotAnswer) -> list[str]:
    c = answer.certificate
    if c is None or c.passed:
        return []
    numbers = (
        f"chief ray {c.chief_difference_px:.3g} px (tolerance {c.chief_tolerance_px:g}), "
        f"centroid {c.centroid_difference_px:.3g} px ({c.centroid_tolerance_px:g}), "
        f"flux {c.flux_difference:.3g} ({c.flux_tolerance:g})"
    )
    return [f"  {pair.sample_id} {position}: {numbers}"]


def _window(layer: SpotLayer) -> SpotWindow:
    images = (layer.electrons_per_s, layer.du_electrons_per_s_px, layer.dv_electrons_per_s_px)
    return SpotWindow(layer.u0_px, layer.v0_px, *images)


def _reaches(view: View, window: SpotWindow) -> bool:
    """Whether any light of the spot falls on the image."""
    camera = view.rig.camera
    image = np.zeros((3, camera.height_px, camera.width_px))
    window.add_to(image)
    return bool(image.any())
