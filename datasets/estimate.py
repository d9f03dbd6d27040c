"""What a run will take: bytes and seconds, from what each kind of task took on one core.

CPU seconds on one core of a 2-core AMD EPYC virtual machine, llvm_ad_rgb, room `lab`, 1280 x 720; another machine
differs by its speed. `make benchmark` shows the forecast beside a run.
The light map is counted as if no cache held it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from phibench.datasets.plan import Plan
from phibench.datasets.task import Task
from phibench.render.bake import fixed_shapes
from phibench.render.patches import cut, texel_count

# Seconds.
START_S = 6.0  # workers, Mitsuba in each, first kernels, hashes
VIEW_S = 0.8
VIEW_S_PER_MEGAPIXEL = 4.5  # refinement, truth, encoding, fsync
VIEW_S_PER_MEGASAMPLE = 0.1  # look-ups in the light map, a million of them
BAKE_S_PER_MEGARAY = 0.13  # of the light map; none where the user's cache has it
SPOT_S = 0.4  # two positions with their certificates
SAMPLE_S_PER_MEGAPIXEL = 0.7  # picture, noise budget

# Bytes.
_AMBIENT_BYTES_PX = 24.0  # six noisy float32 planes do not compress
_TRUTH_BYTES_PX = 13.5  # ten float32 planes; what is outside the mirror compresses to nothing
_PREVIEW_BYTES_PX = 2.8
_SPOT_BYTES = 8192
_TEXEL_BYTES = 25.0  # six float32 and a bool
_RESERVE = 1.1


@dataclass(frozen=True)
class Estimate:
    """How many tasks of each kind, how many bytes on the disk, how many seconds of one core, how many of them alone."""

    counts: dict[str, int]
    size: int
    core_s: float
    alone_s: float  # the light map: views wait for it, and it is one task

    def text(self, workers: int) -> str:
        """One sentence for the terminal."""
        counts = ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in self.counts.items() if n)
        shared_s = (self.core_s - self.alone_s) / max(min(workers, sum(self.counts.values())), 1)
        seconds = START_S + self.alone_s + shared_s
        took = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
        return f"to make: {counts}; about {megabytes(self.size)}, {took} with {workers} worker{'s' * (workers != 1)}"


def estimate(plan: Plan, tasks: Collection[Task]) -> Estimate:
    """Cost of these tasks of a plan."""
    counts = {kind: sum(task.kind == kind for task in tasks) for kind in dict.fromkeys(task.kind for task in tasks)}
    pixels = plan.rig.camera.width_px * plan.rig.camera.height_px
    size = {
        "bake": _TEXEL_BYTES * _texels(plan),
        "view": pixels * (_AMBIENT_BYTES_PX + _TRUTH_BYTES_PX + _PREVIEW_BYTES_PX),
        "spot": 2.0 * _SPOT_BYTES,
        "sample": 0.5 * pixels * _PREVIEW_BYTES_PX,
    }
    seconds = _seconds(plan, pixels / 1e6)
    spent = {kind: count * seconds.get(kind, 0.0) for kind, count in counts.items()}
    total = sum(count * size.get(kind, 0.0) for kind, count in counts.items())
    return Estimate(counts, int(_RESERVE * total), sum(spent.values()), spent.get("bake", 0.0))


def megabytes(count: int) -> str:
    """Bytes for people."""
    return f"{count / 1e6:.0f} MB" if count < 5e9 else f"{count / 1e9:.0f} GB"


def _bake_rays(plan: Plan) -> float:
    """Rays of a light map: texels times rays per texel."""
    ambient, lamps = plan.recipe.ambient, sum(surface.emits for surface in plan.room.surfaces)
    rays = ambient.bounces * ambient.bounce_rays + 2 * (lamps * ambient.lamp_rays + ambient.final_rays)
    return float(rays * _texels(plan))


def _texels(plan: Plan) -> int:
    return texel_count(cut(fixed_shapes(plan.room), plan.recipe.ambient.texel_m))


def _seconds(plan: Plan, megapixels: float) -> dict[str, float]:
    ambient = plan.recipe.ambient
    samples = megapixels * 2 * ambient.cells_per_pixel**2 * VIEW_S_PER_MEGASAMPLE
    return {
        "bake": _bake_rays(plan) / 1e6 * BAKE_S_PER_MEGARAY,
        "view": VIEW_S + megapixels * VIEW_S_PER_MEGAPIXEL + samples,
        "spot": SPOT_S,
        "sample": megapixels * SAMPLE_S_PER_MEGAPIXEL,
    }
