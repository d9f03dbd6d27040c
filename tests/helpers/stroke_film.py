"""A film of a stroke in empty space: exact positions by the simulator, and positions with drawn noise."""

from __future__ import annotations

from functools import cache

import numpy as np

from phibench.render.film.moving_rows import chief_uv_px
from phibench.robot.film.film_positions import FilmPositions
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.motion.film_times import FilmTimes
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

FRAMES = 24
NOISE_PX, ENCODER_M = 0.05, 3e-4
SPOT = LaserSpot((2.0, 1.0, 0.5), (-0.894427191, -0.447213595, 0.0), 5e-3)
SCENE = FilmScene(Rig(), SPOT, FilmTimes(FRAMES, 20.0, 1 / 60, 0.03, 720), Carriage((0.0, 0.5), (0.1, 0.1), 0.6, 4.0))
DEPTH_M = float(np.hypot(2.0, 1.0))
POINT = np.array(SPOT.position_world_m)


@cache
def exact() -> tuple[Array, Array]:
    """Offsets and exact positions by the simulator: its own solver of the reflection."""
    times = SCENE.times.frame_s
    return SCENE.offset_m(times), chief_uv_px(SCENE, times)


def drawn(number: int, noise_px: float = NOISE_PX, encoder_m: float = ENCODER_M) -> tuple[FilmPositions, Array]:
    offsets, uv = exact()
    rng = generator("film depth", number)
    each = np.broadcast_to(NOISE_PX**2 * np.eye(2), (FRAMES, 2, 2))
    noisy = uv + noise_px * rng.standard_normal(uv.shape)
    return FilmPositions(noisy, each, np.zeros((FRAMES, 2, FRAMES, 2))), offsets + encoder_m * rng.standard_normal(
        FRAMES
    )
