# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Tutorial 3: real frames
#
# At the end you have:
#
# * D of a laser spot from two pictures, with its standard deviation and its causes;
# * a look at how far your mirror is off its place;
# * a table of several pairs, and a data set of them on which every method can be scored.
#
# You need pictures of a rig: a camera that looks up at a mirror ball, at two heights, with the laser on and off. If you
# have none yet, the first step makes some. They are simulated, with a rig that is not built as drawn.
#
# You need `make setup`, and a terminal in which `phibench` is a command: `. .venv/bin/activate`. Then
#
# ```
# python docs/run_notebook.py docs/tutorials/real_frames.py out/real_frames
# ```
#
# runs all of it in that folder, and writes a notebook with its outputs there. You can also open the file in Jupyter
# (with jupytext), or type cell by cell.

# %%
import os
from pathlib import Path

from PIL import Image

import phibench

os.environ["TTY_COMPATIBLE"] = "0"  # commands below write plain lines

# %% [markdown]
# ## 1. Pictures
#
# Skip this step if you have your own. The true ball is 1 mm off its place, and the camera is tilted by 5 mrad. The
# stroke is 0.5 mm too long. Nobody tells the programs that follow.

# %%
recipe = """
[dataset]
name = "photographs"
seed = 5

[rig]
preset = "default"

[misalignment]
decentre_x_m = 1e-3
tilt_y_rad = -5e-3
stroke_offset_m = 5e-4

[ambient]
quality = "training"
cells_per_pixel = 2
texel_m = 0.25
lamp_rays = 8
bounces = 3
bounce_rays = 16
final_rays = 32

[[experiments]]
name = "wall"
targets = ["near", "middle", "far"]
strokes_m = [0.5]

[[targets]]
name = "near"
depth_m = 1.4
azimuth_deg = 30.0
height_m = 0.50

[[targets]]
name = "middle"
depth_m = 2.0
azimuth_deg = 150.0
height_m = 0.50

[[targets]]
name = "far"
depth_m = 2.8
azimuth_deg = 270.0
height_m = 0.50
"""
_ = Path("photographs.toml").write_text(recipe)

# %% language="bash"
# phibench dataset make photographs.toml --out truth
# phibench dataset frames truth --preset mjpeg --laser-off --out frames

# %% [markdown]
# From here on only files are used that a person with a rig has: pictures, a ruler and a tape.

# %%
folder = Path("pictures")
folder.mkdir(exist_ok=True)
lines = ["name,down,up,down_off,up_off,stroke_m,depth_m,depth_sigma_m"]
for sample in phibench.open_dataset("truth"):
    name = sample.row.sample_id
    files = [f"{name}-{position}-{laser}-0000.jpg" for laser in ("on", "off") for position in ("down", "up")]
    for file in files:
        (folder / file).write_bytes((Path("frames") / file).read_bytes())
    tape_m = sample.row.depth_m  # a tape, good to 2 mm
    lines.append(f"{name},{','.join(files)},{sample.row.nominal_stroke_m},{tape_m:.3f},0.002")
(folder / "pairs.csv").write_text("\n".join(lines) + "\n")
(folder / "rig.toml").write_text("[rig]\nradius_m = 0.060   # of the ball\nz_c_m = 0.26        # lens to its centre\n")
print("\n".join(lines))

# %% [markdown]
# ## 2. Is the mirror in its place?
#
# The outline of the ball in one picture says it. The place of the ball and the tilt of the camera look alike there. The
# standard deviation counts what is not known of the camera.
# Of the 2.3 mm below, 1 mm is the ball, and 1.3 mm is 5 mrad of tilt over 0.26 m.

# %%
on, off = lines[2].split(",")[1], lines[2].split(",")[3]
print("picture with the laser off:", off)

# %% language="bash"
# phibench align pictures/wall-middle-h0.500-down-off-0000.jpg --rig pictures/rig.toml --out aligned.png

# %% [markdown]
# ## 3. One pair
#
# The outlines in the pictures correct the rig. What they cannot tell stays in sigma.

# %% language="bash"
# cd pictures
# phibench measure --down wall-middle-h0.500-down-on-0000.jpg --up wall-middle-h0.500-up-on-0000.jpg \
#     --down-off wall-middle-h0.500-down-off-0000.jpg --up-off wall-middle-h0.500-up-off-0000.jpg \
#     --stroke-m 0.5 --rig rig.toml --out ../found.png

# %%
picture = Image.open("found.png")
picture.thumbnail((1000, 1000))
picture

# %% [markdown]
# ## 4. A folder of pairs
#
# The tape's D is 1.4, 2.0 and 2.8 m. Each answer should be within two of its sigmas, in 19 of 20 pairs.

# %% language="bash"
# phibench measure pictures --rig pictures/rig.toml --out results.csv

# %% [markdown]
# ## 5. A data set of your own
#
# The tape takes the place of the truth, so that any method can be scored on your pictures.

# %% language="bash"
# phibench import pictures --out mine
# phibench score mine --method chain_fit --rank depth --out mine.json

# %% [markdown]
# ## What next
#
# * All options, the rig file and what is refused: [measuring](../measure.md).
# * Twenty pairs with a tape calibrate the rig: [calibration](../calibration.md).
# * Measure your camera's noise, and use it: [frames of a real camera](../capture.md).
