"""Scene of one view in standard Mitsuba plugins: all its light, the room's alone, or the laser spot alone.

Units are millimetres, with the sphere centre at the origin: in metres with the origin on the floor Mitsuba's ray offset
moves the spot by 0.01 px. Colours are three bands, one for each colour filter of the detector, in Mitsuba's rgb mode.
Layers are per filter, no measured spectra of the room's materials exist, and the laser is handled at its own wavelength
elsewhere: a spectral variant would add colour noise for no gain in truth.
"""

from __future__ import annotations

from typing import Literal

from phibench.render.plugins.mirror_plugins import mirror_plugin
from phibench.render.plugins.plugin_tree import Plugin, SceneSetting, Value
from phibench.render.plugins.room_plugins import room_plugins
from phibench.render.plugins.sensor_plugin import DEPTH, sensor_plugin
from phibench.render.plugins.spot_plugins import spot_plugins
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME, Room

Light = Literal["all", "ambient", "spot"]
_SPOT_DEPTH = (
    4  # over the mirror, and through what a mask leaves open: the layer has none of the light that the room sends back
)
LIGHTS: tuple[Light, ...] = ("all", "ambient", "spot")


def standard_scene(view: View, room: Room, spot: LaserSpot | None = None, light: Light = "all") -> Plugin:
    """Whole scene of one view: integrator, sensor, mirror, every shape of the room, and the spot.

    Parameters
    ----------
    view, room
    spot : LaserSpot, or None
    light : "all", "ambient" or "spot"
        Of the room and the spot, of the room, or of the spot, whose scene has no other light.

    Raises
    ------
    SceneError
        If no standard plugin reflects as the mirror does.
    """
    depth = _SPOT_DEPTH if light == "spot" else DEPTH
    values: dict[str, Value] = {
        "integrator": Plugin("integrator", "path", {"max_depth": SceneSetting("max_depth", depth)}),
        "sensor": sensor_plugin(view),
        MIRROR_NAME: mirror_plugin(view),
    }
    values |= room_plugins(view, room, lit=light != "spot")
    if spot is not None and light != "ambient":
        values |= spot_plugins(view, spot, room, alone=light == "spot")
    return Plugin("scene", "scene", values)
