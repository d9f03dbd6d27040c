"""Task of one sample's spot in both views: exact answer, layer, certificate, manifest row. Needs NumPy only."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from phibench.datasets.build.tasks import TaskResult
from phibench.datasets.common.errors import RefusedSampleError
from phibench.datasets.plan.plan import PairPlan
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.layers import SpotWindow, write_spot
from phibench.datasets.store.schema import CertificateRow, LightRow, ManifestRow, SpotRow
from phibench.render.optics.certificate import Certificate, certify
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import SpotLayer, spot_layer, spot_light
from phibench.render.optics.truth import SpotTruth, depth_m, spot_truth
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, View
from phibench.scenes.room import Room

_LOG2_MORE_PAIRS = (19, 21)  # four and sixteen times those of a spot that an edge cuts


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


def answer_spot(view: View, spot: LaserSpot, room: Room) -> SpotAnswer:
    """Compute one spot in one view.

    A certificate takes more rays before a difference counts. So does the layer: where they still differ it is made
    again with more pairs, as edges and grazing light may need them.
    """
    geometry = room_geometry(room, view)
    truth, layer = spot_truth(view, spot, geometry), spot_layer(view, spot, geometry)
    certificate = certify(view, spot, geometry, truth, layer) if truth.visible else None
    for log2_pairs in _LOG2_MORE_PAIRS:
        if certificate is None or certificate.passed or not certificate.chief_rays_agree:
            break  # more pairs do not help where the chief rays disagree
        layer = spot_layer(view, spot, geometry, log2_pairs)
        certificate = certify(view, spot, geometry, truth, layer)
    return SpotAnswer(truth, layer, certificate, _reaches(view, _window(layer)))


def make_spot(out: Path, dataset: str, rig: Rig, source: RoomSource, spot: LaserSpot, pair: PairPlan) -> TaskResult:
    """Task: both spot layers of a sample and its row of the manifest.

    Raises
    ------
    RefusedSampleError
        If a certificate is out of tolerance, with its numbers.
    """
    views = {position: rig.at(pair.offset_m(position)) for position in POSITIONS}
    room = room_of(source, out / schema.ROOM_FILES)
    answers = {position: answer_spot(view, spot, room) for position, view in views.items()}
    if fault := certificate_fault(answers):
        raise RefusedSampleError(fault)
    rows = {}
    for position, answer in answers.items():
        file = _write_layer(out, dataset, pair, position, answer)
        rows[position] = _spot_row(pair.pose_id(position), views[position], answer, file)
    row = manifest_row(rig, spot, pair, rows["down"], rows["up"])
    return TaskResult(tuple(r.spot_file for r in rows.values() if r.spot_file is not None), row.model_dump(mode="json"))


OUT_OF_TOLERANCE = "a certificate is out of tolerance"


def certificate_fault(answers: Mapping[str, SpotAnswer]) -> str:
    """Cause for which a sample is refused by the certificates of both positions; empty if it is not."""
    told = [text for position in POSITIONS for text in _complaints(position, answers[position])]
    return f"{OUT_OF_TOLERANCE} ({'; '.join(told)})" if told else ""


def _write_layer(out: Path, dataset: str, pair: PairPlan, position: str, answer: SpotAnswer) -> str | None:
    """Write a spot layer, or make sure that there is none where no light reaches the image."""
    file = schema.spot_file(pair.sample_id, position)
    if not answer.on_image:
        (out / file).unlink(missing_ok=True)
        return None  # a file of an earlier draw must not stay
    write_spot(
        out / file, _window(answer.layer), {"dataset": dataset, "sample_id": pair.sample_id, "position": position}
    )
    return file


def manifest_row(rig: Rig, spot: LaserSpot, pair: PairPlan, down: SpotRow, up: SpotRow) -> ManifestRow:
    """One row of the manifest."""
    centre = rig.at(0.0).sphere_centre_m
    return ManifestRow(
        sample_id=pair.sample_id,
        experiment=pair.experiment,
        target=pair.target,
        rig=pair.rig,
        nominal_rig=pair.nominal_rig,
        room=pair.room,
        depth_m=float(depth_m(np.array(spot.position_world_m), centre)),
        light_depth_m=light_depth_m((down, up), centre),
        stroke_m=pair.stroke_m,
        nominal_stroke_m=pair.nominal_stroke_m,
        spot_world_m=_triple(spot.position_world_m),
        spot_normal_world=_triple(spot.normal_world),
        spot_beam_world=None if spot.beam_direction_world is None else _triple(spot.beam_direction_world),
        spot_diameter_m=spot.diameter_m,
        down=down,
        up=up,
        tries=pair.tries,
        drawn=dict(pair.drawn),
    )


def light_depth_m(rows: Iterable[SpotRow], sphere_centre_down_m: Array) -> float:
    """D of the light on the surfaces: of the mean place of the views that see the spot; NaN where none does."""
    places = [row.light.place_world_m for row in rows if row.visible and row.light is not None]
    return float(depth_m(np.mean(places, axis=0), sphere_centre_down_m)) if places else math.nan


def _spot_row(pose_id: str, view: View, answer: SpotAnswer, file: str | None) -> SpotRow:
    certificate, light = answer.certificate, spot_light(view, answer.layer)
    return SpotRow(
        pose=pose_id,
        offset_m=view.offset_m,
        **asdict(answer.truth),
        coma_shift_px=answer.coma_shift_px,
        light=None if light is None else LightRow(**vars(light)),
        electrons_per_s=_triple(answer.layer.total_electrons_per_s),
        view_ambient_file=schema.view_file(pose_id, "ambient"),
        view_truth_file=schema.view_file(pose_id, "truth"),
        spot_file=file,
        certificate=None if certificate is None else CertificateRow(**asdict(certificate)),
        noise=None,  # known when the views are there: `sample_task`
    )


def _triple(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _complaints(position: str, answer: SpotAnswer) -> list[str]:
    c = answer.certificate
    if c is None or c.passed:
        return []  # nothing was traced, or all is well
    numbers = (
        f"chief ray {c.chief_difference_px:.3g} px (tolerance {c.chief_tolerance_px:g}), "
        f"centroid {c.centroid_difference_px:.3g} px ({c.centroid_tolerance_px:g}), "
        f"flux {c.flux_difference:.3g} ({c.flux_tolerance:g})"
    )
    return [f"{position}: {numbers}"]


def _window(layer: SpotLayer) -> SpotWindow:
    images = (layer.electrons_per_s, layer.du_electrons_per_s_px, layer.dv_electrons_per_s_px)
    return SpotWindow(layer.u0_px, layer.v0_px, *images)


def _reaches(view: View, window: SpotWindow) -> bool:
    """Return True if any light of the spot falls on the image."""
    camera = view.rig.camera
    image = np.zeros((3, camera.height_px, camera.width_px))
    window.add_to(image)
    return bool(image.any())
