# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Tutorial 1: a method of your own
#
# At the end you have:
#
# * a small data set, rendered on your machine in about a minute;
# * a method of twelve lines that finds the laser spot;
# * its score with a confidence interval, beside a simple method and a careful one;
# * the reason why it is not better, and a page to look at a sample.
#
# You need `make setup`, and a terminal in which `phibench` is a command: `. .venv/bin/activate`. Then
#
# ```
# python docs/run_notebook.py docs/tutorials/own_method.py out/own_method
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
from phibench import Answer, Pair, Spot

os.environ["TTY_COMPATIBLE"] = "0"  # commands below write plain lines

# %% [markdown]
# ## 1. A data set
#
# A recipe says what is rendered. This one has six spots on boards, seen by a small camera. Its images have a quarter of
# the real one's side, to be fast. One stroke of 0.5 m means two views of the room.

# %%
BOARDS = {
    "a": (1.2, 20.0),
    "b": (1.6, 75.0),
    "c": (2.0, 130.0),
    "d": (2.4, 185.0),
    "e": (2.8, 240.0),
    "f": (3.2, 295.0),
}
recipe = """
[dataset]
name = "tutorial"
seed = 1

[rig]
width_px = 320
height_px = 180
fx_px = 357.5
fy_px = 357.5
pixel_pitch_um = 11.2     # large pixels: the same sensor with fewer of them
f_number = 9.6            # and each gets as much light as one of the real camera

[laser]
power_w = 16e-3

[ambient]
quality = "training"
texel_m = 0.5             # a coarse light map
lamp_rays = 8
bounces = 2
bounce_rays = 8
final_rays = 16

[[experiments]]
name = "boards"
targets = ["a", "b", "c", "d", "e", "f"]
strokes_m = [0.5]
"""
for name, (depth_m, azimuth_deg) in BOARDS.items():
    recipe += f'\n[[targets]]\nname = "{name}"\ndepth_m = {depth_m}\nazimuth_deg = {azimuth_deg}\nheight_m = 0.50\n'
_ = Path("tutorial.toml").write_text(recipe)

# %% language="bash"
# phibench dataset make tutorial.toml --out tutorial

# %%
dataset = phibench.open_dataset("tutorial")
dataset

# %% [markdown]
# ## 2. Look at a pair
#
# A method gets frames of the camera, here JPEG, with the laser on and with the laser off. It knows the nominal rig. It
# does not know the truth, which the data set has: the pixel of the spot, the angles, and D.

# %%
sample = dataset[2]
frames = sample.camera_frames("mjpeg", draw=0, laser_off=True)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.9), layout="constrained")
for axis, image, name in zip(axes, (frames.down, frames.up), ("down", "up"), strict=True):
    spot = sample.truth_row(name)
    axis.imshow(image)
    axis.plot(spot.u_px, spot.v_px, "+", color="lime", markersize=14)
    axis.set_title(f"{name}: true spot at ({spot.u_px:.2f}, {spot.v_px:.2f}) px")
plt.show()

# %% [markdown]
# ## 3. Write a method
#
# It subtracts the frame without the laser, smooths, takes the brightest place, and then the centre of mass around it.
# Two rules matter. A pixel is (u, v), column and row. Integers are pixel centres, so nothing is added or taken away.


# %%
def centre(on: np.ndarray, off: np.ndarray) -> Spot:
    light = on.astype(float)[..., 0] - off.astype(float)[..., 0]  # the red plane
    smooth = sum(np.roll(light, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    v0, u0 = np.unravel_index(np.argmax(smooth), smooth.shape)
    if smooth[v0, u0] < 60.0:
        return Spot.missing("nothing is brighter than before")
    v, u = (np.clip(np.arange(x - 3, x + 4), 0, n - 1) for x, n in ((v0, light.shape[0]), (u0, light.shape[1])))
    window = np.clip(light[np.ix_(v, u)], 0.0, None)
    return Spot((float((window.sum(0) * u).sum() / window.sum()), float((window.sum(1) * v).sum() / window.sum())))


def extract(pair: Pair) -> Answer:
    return Answer(down=centre(pair.down, pair.down_off), up=centre(pair.up, pair.up_off))


# %% [markdown]
# One pair, by hand. The answer should be within a pixel of the truth:

# %%
spot = centre(frames.down, frames.down_off)
print("answer", np.round(spot.uv_px, 2), "truth", np.round([sample.row.down.u_px, sample.row.down.v_px], 2))

# %% [markdown]
# ## 4. Score it
#
# `score` draws frames, asks the method, and compares with the truth. Intervals are 95 %, from a bootstrap over samples.
# With six samples they are wide: this is a tutorial, not a result. `chain_fit` fits the camera's whole chain. An
# efficiency of 1 is the bound: no method with the same knowledge of the image is better.

# %%
methods = {"mine": extract, "red_centroid": "red_centroid", "chain_fit": "chain_fit"}
scores = {name: phibench.score(dataset, method, preset="mjpeg") for name, method in methods.items()}
print(f"{'':14}{'position rms, px':>26}{'efficiency':>26}{'D rms, relative':>28}")
for name, scored in scores.items():
    metrics = [scored.document.metrics[key] for key in ("rms_px", "efficiency_px", "rms_depth_relative")]
    print(f"{name:14}" + "".join(f"{m.value:10.3f} ({m.low:.3f} to {m.high:.3f})" for m in metrics))

# %% [markdown]
# ## 5. Why it is not better
#
# Red is known at every second pixel only, and JPEG halves the colours again. A centre of mass sees that as a shift. It
# depends on the place in the 2 x 2 cell of the mosaic. It stays when the light grows: it is bias, not noise.

# %%
records = scores["mine"].records
figure, axis = plt.subplots(figsize=(4.2, 3.6), layout="constrained")
axis.axhline(0, color="grey", linewidth=0.6)
axis.axvline(0, color="grey", linewidth=0.6)
for name, marker in (("mine", "o"), ("chain_fit", "x")):
    table = scores[name].records
    axis.plot(table["du_px"], table["dv_px"], marker, label=name)
axis.set(xlabel="error of u, px", ylabel="error of v, px", aspect="equal")
axis.legend()
plt.show()

# %% [markdown]
# ## 6. Look at a sample
#
# This writes one HTML file. Open it, and move the pointer: it tells what every pixel sees.

# %% language="bash"
# phibench dataset show tutorial --sample 2 --html sample.html

# %% [markdown]
# ## What next
#
# * Put `extract` into a file and score it as `my_phi.py:extract`: it then runs alone, with limits of time and memory.
# * Score on the paper's 25 pairs of full size (`make dataset`), then on [the benchmark](../release.md).
# * What a method gets and may answer: [a method of your own](../method.md). What the numbers mean:
#   [scoring](../scoring.md).
