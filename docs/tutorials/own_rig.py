# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Tutorial 2: a rig, a room and a mirror of your own
#
# At the end you have:
#
# * a data set of a rig that nobody has built: a hyperbolic mirror above the camera, in a room of your choice;
# * its pictures and the exact distance of everything that they show;
# * the best accuracy of D that such a rig can have, and what a millimetre of error in the stroke costs.
#
# You need `make setup`, and a terminal in which `phibench` is a command: `. .venv/bin/activate`. Then
#
# ```
# python docs/run_notebook.py docs/tutorials/own_rig.py out/own_rig
# ```
#
# runs all of it in that folder, and writes a notebook with its outputs there. You can also open the file in Jupyter
# (with jupytext), or type cell by cell.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import phibench
from phibench.datasets.exposures.expected_electrons import expected_region
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.rig_parameters import rig_covariance
from phibench.estimator.limits.position_bound import depth_limit, spot_limit
from phibench.render.sensor.settings import sensor

os.environ["TTY_COMPATIBLE"] = "0"  # commands below write plain lines

# %% [markdown]
# ## 1. The recipe
#
# `[rig]` is the camera. `[rig.mirror]` replaces the ball. `[rooms]` draws a room; here it is a workshop of 6 x 5 m.
# `[random]` draws spots on whatever the laser meets. The image has a quarter of the real one's side, to be fast.

# %%
recipe = """
[dataset]
name = "workshop"
seed = 3

[rig]
width_px = 320
height_px = 180
fx_px = 357.5
fy_px = 357.5
pixel_pitch_um = 11.2
f_number = 9.6

[rig.mirror]
shape = "hyperboloid"
rim_radius_m = 0.060

[rooms]
count = 1

[rooms.properties]
use = "workshop"
length_m = 6.0
width_m = 5.0
height_m = 2.6
l_shape = 0

[laser]
power_w = 16e-3
albedo = "surface"

[ambient]
quality = "training"
texel_m = 0.5
lamp_rays = 8
bounces = 2
bounce_rays = 8
final_rays = 16

[random]
samples = 4
stroke_m = 0.4

[random.spot]
azimuth_deg = { uniform = [0.0, 360.0] }
height_m = 0.45
elevation_deg = { uniform = [-10.0, 10.0] }
"""
_ = Path("workshop.toml").write_text(recipe)

# %% [markdown]
# A dry run says what will be seen and what it costs. Nothing is rendered.

# %% language="bash"
# phibench dataset make workshop.toml --out workshop --dry-run

# %% [markdown]
# A mistake ends in one sentence. Here the mirror is wider than allowed:

# %% language="bash"
# sed 's/rim_radius_m = 0.060/rim_radius_m = 60/' workshop.toml > wrong.toml
# phibench dataset make wrong.toml --out wrong || true

# %% [markdown]
# ## 2. Render it

# %% language="bash"
# phibench dataset make workshop.toml --out workshop

# %%
dataset = phibench.open_dataset("workshop")
dataset

# %% [markdown]
# ## 3. What the camera sees, and how far it is
#
# On the left is a frame, on the right the truth of every pixel: the horizontal distance D of what the pixel sees.

# %%
sample = dataset[0]
truth = sample.truth("down")
figure, axes = plt.subplots(1, 2, figsize=(9.4, 2.9), layout="constrained")
axes[0].imshow(sample.camera_frames("mjpeg").down)
axes[0].set_title("frame, down")
shown = axes[1].imshow(truth["depth_m"], cmap="viridis")
axes[1].set_title("D of every pixel")
figure.colorbar(shown, label="m")
plt.show()

# %%
row, column = 60, 200
name = sample.object_names[int(truth["object_id"][row, column])]
print(f"pixel (u, v) = ({column}, {row}) sees {name}, D = {truth['depth_m'][row, column]:.3f} m")

# %% [markdown]
# ## 4. How accurate D can be
#
# The noise of the pixels bounds the position of a spot, and the positions bound D. The rig's own errors come on top.
# Here the stroke is known to 0.5 mm and the distance from lens to mirror to 0.2 mm, one standard deviation.
# [Limits](../limits.md) has the equations.

# %%
camera = sensor("bayer-raw", exposure_s=1 / 60)
rig_errors = rig_covariance({"stroke_offset_m": 5e-4, "axial_m": 2e-4})
print("   D, m   one sigma of D, mm: spots     rig")
for sample in dataset:
    if not (sample.row.down.visible and sample.row.up.visible):
        print(f"{sample.row.depth_m:7.3f}   not seen: {sample.row.down.cause}, {sample.row.up.cause}")
        continue
    bounds = [spot_limit(expected_region(sample, p, camera), card_of(camera)).covariance_px2 for p in ("down", "up")]
    places = [(s.u_px, s.v_px) for s in (sample.row.down, sample.row.up)]
    limit = depth_limit(sample.rig, sample.row.stroke_m, *places, *bounds, rig_errors)
    parts = 1e3 * np.array([limit.sigma_spot_m, limit.sigma_calibration_m])
    print(f"{sample.row.depth_m:7.3f} {parts[0]:28.1f} {parts[1]:7.1f}")

# %% [markdown]
# `sensitivities.parquet` has the slopes for each of the rig's parameters and every estimator. If the true stroke is
# 1 mm longer than the nominal one, D comes out too small:

# %%
table = dataset.sensitivities()
for sample_id, estimator, slope in table.select("sample_id", "estimator", "estimate_m_per_stroke_offset_m").iter_rows():
    if estimator == "exact":
        print(f"{sample_id}: {slope:6.2f} mm of D per mm of the stroke")

# %% [markdown]
# ## What next
#
# * Every key of a recipe: [RECIPE](../../datasets/RECIPE.md). What can be changed, and what not:
#   [changing](../changing.md).
# * Mirrors: [shapes](../mirrors.md), and [which one to build](../studies/mirror.md). Rooms: [rooms](../rooms.md), also
#   from panoramas and meshes of your own.
# * Leave out the small image and the coarse light map for a data set to measure with.
