"""Mean and covariance of the chain's output over noise realisations of one camera.

Raw stages have a closed form; demosaicing, white balance and colour matrix are a sparse matrix. The rest (clipping,
sRGB curve, sharpening, 8 bits, JPEG) is simulated. The fixed pattern of the camera is part of the mean.

Closed form of a pixel with mean charge m (light x PRNU + dark current) and system gain K:

    mean      black level + K (m + DSNU)
    variance  K^2 (m + read noise^2) + 1/12 DN^2, and K^2 row noise^2 common to a row

1/12 DN^2 is the rounding's, once per pixel. For a noise of s DN before rounding it is off by up to
(4 s^2 + 1/pi^2) exp(-2 pi^2 s^2) DN^2 (Sheppard's correction, first harmonic): 1e-8 at 1 DN, but 0.07 at the 0.32 DN of
a dark pixel at gain 1, whose moments are better simulated. Full well and the converter's ends are assumed out of reach.
Speckle flicker adds the outer product of the spot's DN with itself, over M.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, mean_charge, whole_tiles
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.processing import linear_rgb, linear_signal
from phibench.render.sensor.settings import Sensor
from phibench.scenes.frames import Array

QUANTISATION_DN2 = 1.0 / 12.0
_COMB_PX = 4  # even, for the mosaic; more than the 3 pixels that one pixel's interpolation reaches


@dataclass(frozen=True)
class RawMoments:
    """Moments of a region's DN.

    Attributes
    ----------
    mean_dn : array, shape (h, w)
    variance_dn2 : array, shape (h, w)
        What is independent from pixel to pixel.
    row_variance_dn2 : float
        What is common to the pixels of a row.
    flicker_dn : array, shape (h, w)
        One standard deviation of the speckle flicker.
    """

    mean_dn: Array
    variance_dn2: Array
    row_variance_dn2: float
    flicker_dn: Array

    def covariance_dn2(self) -> Array:
        """Covariance of the pixels in the order of ``mean_dn.ravel()``, shape (hw, hw)."""
        rows = np.repeat(np.arange(self.mean_dn.shape[0]), self.mean_dn.shape[1])
        flicker = self.flicker_dn.ravel()
        same_row = rows[:, None] == rows
        return np.diag(self.variance_dn2.ravel()) + self.row_variance_dn2 * same_row + np.outer(flicker, flicker)


@dataclass(frozen=True)
class Moments:
    """Moments of a region of the output.

    Attributes
    ----------
    mean : array, of the output's shape
    covariance : array, shape (n, n), in the order of ``mean.ravel()``
    draws : int
        0 for closed forms; otherwise the mean has the standard error sqrt(diag / draws).
    """

    mean: Array
    covariance: Array
    draws: int = 0


def raw_moments(chain: Chain, light: Light, region: Region) -> RawMoments:
    """Closed form for the output "raw"."""
    sensor, tiles = chain.sensor, whole_tiles(region, light.size)
    pattern, part = chain.pattern(tiles), region.slices(tiles)
    photo = chain.photo_electrons(light, tiles)
    charge = mean_charge(photo, sensor, pattern)
    shot = charge if sensor.shot_noise else 0.0
    mean = sensor.black_level_dn + sensor.dn_per_e * (charge + pattern.offset_e)
    variance = np.broadcast_to(sensor.dn_per_e**2 * (shot + sensor.read_noise_e**2) + QUANTISATION_DN2, photo.shape)
    flicker = np.zeros(photo.shape)
    if sensor.speckle_m is not None:
        # the spot alone flickers, and all its pixels together
        spot = (photo - chain.photo_electrons(light.without_spot(), tiles)) * pattern.responsivity
        flicker = sensor.dn_per_e * spot / np.sqrt(sensor.speckle_m)
    return RawMoments(mean[part], variance[part], (sensor.dn_per_e * sensor.row_noise_e) ** 2, flicker[part])


def linear_operator(sensor: Sensor, shape: tuple[int, int]) -> sparse.csr_array:
    """Matrix of demosaicing, white balance and colour matrix, shape (3hw, hw), for a mosaic of `shape`, red first.

    Found by sending combs of single bright pixels through the code itself.
    """
    height, width = shape
    rows, columns = np.indices(shape)
    parts = []
    for v in range(_COMB_PX):
        for u in range(_COMB_PX):
            comb = ((rows % _COMB_PX == v) & (columns % _COMB_PX == u)).astype(float)
            plane, row, column = np.nonzero(answer := linear_rgb(comb, sensor))
            # the comb's pixel within 1 px of the output pixel
            from_row, from_column = (x + (y - x + 1) % _COMB_PX - 1 for x, y in ((row, v), (column, u)))
            where = ((plane * height + row) * width + column, from_row * width + from_column)
            parts.append((answer[plane, row, column], where))
    values, targets, sources = (np.concatenate(x) for x in zip(*((p[0], *p[1]) for p in parts), strict=True))
    return sparse.csr_array((values, (targets, sources)), shape=(3 * height * width, height * width))


def linear_moments(chain: Chain, light: Light, region: Region) -> Moments:
    """Moments of the linear planes R, G, B, mean shape (3, h, w), full scale 1, before they are cut to [0, 1]."""
    box = chain.raw_region(region, light.size)
    raw = raw_moments(chain, light, box)
    keep = np.zeros((3, *box.shape), bool)
    keep[(slice(None), *region.slices(box))] = True
    operator = linear_operator(chain.sensor, box.shape)[np.flatnonzero(keep)]
    mean = operator @ linear_signal(raw.mean_dn, chain.sensor).ravel()
    # operator C operator^T, with C symmetric
    scale = 1.0 / (chain.sensor.top_dn - chain.sensor.black_level_dn)
    covariance = operator @ (operator @ raw.covariance_dn2()).T * scale**2
    return Moments(mean.reshape(3, *region.shape), covariance)


def drawn_moments(chain: Chain, light: Light, region: Region, stream: NoiseStream, draws: int) -> Moments:
    """Moments of any output from `draws` frames of the stream; the covariance is the unbiased one."""
    frames = np.stack([chain.frame(light, stream.stage("moment", k), region) for k in range(draws)]).astype(float)
    covariance = np.cov(frames.reshape(draws, -1), rowvar=False)
    return Moments(frames.mean(axis=0), np.atleast_2d(covariance), draws)
