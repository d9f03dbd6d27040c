"""Commands `phibench scene`: samples as scenes for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cyclopts import App

from phibench.cli.options import DATA

scene = App(name="scene", group=DATA, help="Write samples as scenes for other programs.")


@scene.command
def export(
    directory: Path, *, out: Path, sample: str | None = None, position: Literal["down", "up"] | None = None
) -> int:
    """Write a sample as Mitsuba XML with meshes and pictures, for an unmodified Mitsuba.

    Each scene has all its light, the room's alone, or the laser spot alone. Our own images of them lie beside, as
    radiance. README.md in the folder says how to compare, and what a scene does not carry.

    Parameters
    ----------
    directory
        Folder of a data set.
    out
        Folder to write.
    sample
        Sample: its number, counted from 0, or its id; the first one by default.
    position
        "down" or "up"; both by default.
    """
    from phibench.datasets.read import open_finished
    from phibench.datasets.scene.scene_export import export_scene
    from phibench.scenes.rig import POSITIONS

    (chosen,) = open_finished(directory).chosen(["0" if sample is None else sample])
    done = export_scene(chosen, out, POSITIONS if position is None else (position,))
    for loss in done.losses:
        print(f"not carried: {loss}")
    names = ", ".join(path.name for path in done.scenes)
    print(f"{out}: {names}; open one with `mitsuba -m llvm_ad_rgb {done.scenes[0]}`, compare as {done.readme} says")
    return 0
