"""The detector's colour filters and quantum efficiency: light to expected photo-electrons.

A layer holds one plane per colour filter. Ambient light is carried in three bands, one per filter, each with
an effective wavelength and an efficiency (quantum efficiency times filter and lens transmission). The
laser line is handled at its own wavelength. Nobody has published electron-level data of a C310: the numbers are
DESIGN section 4's and marked there as assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

from phibench.scenes.checks import finite_vector, within

PLANCK_J_S = 6.62607015e-34
LIGHT_M_S = 299792458.0
FILTERS = ("R", "G", "B")


@dataclass(frozen=True)
class Detector:
    """Photo-electrons per joule, per colour filter.

    Parameters
    ----------
    band_wavelength_nm : 3 floats
        Effective wavelength of the ambient band that each filter (R, G, B) passes.
    band_efficiency : 3 floats in [0, 1]
        Electrons per ambient photon of the own band, lens and filter included.
    laser_efficiency : float in [0, 1]
        Electrons per laser photon (650 nm) behind the red filter: quantum efficiency x filter.
    laser_filter_response : 3 floats in [0, 1]
        Response of R, G, B at the laser line, relative to the red filter.
    """

    band_wavelength_nm: tuple[float, ...] = (610.0, 540.0, 460.0)
    band_efficiency: tuple[float, ...] = (0.35, 0.40, 0.35)
    laser_efficiency: float = 0.35
    laser_filter_response: tuple[float, ...] = (1.0, 0.10, 0.03)

    def __post_init__(self) -> None:
        within("Detector", "laser_efficiency", self.laser_efficiency, 0.0, 1.0)
        for name, low, high in (
            ("band_wavelength_nm", 400.0, 700.0),
            ("band_efficiency", 0.0, 1.0),
            ("laser_filter_response", 0.0, 1.0),
        ):
            values = finite_vector("Detector", name, getattr(self, name), 3)
            for value in values:
                within("Detector", name, value, low, high)
            object.__setattr__(self, name, values)

    def laser_electrons_per_joule(self, wavelength_nm: float) -> tuple[float, ...]:
        """Expected electrons per joule of laser light on a pixel, for the filters R, G, B."""
        electrons = self.laser_efficiency * photons_per_joule(wavelength_nm)
        return tuple(electrons * response for response in self.laser_filter_response)

    def band_electrons_per_joule(self) -> tuple[float, ...]:
        """Expected electrons per joule of ambient band light on a pixel, for the filters R, G, B."""
        pairs = zip(self.band_efficiency, self.band_wavelength_nm, strict=True)
        return tuple(efficiency * photons_per_joule(nm) for efficiency, nm in pairs)


def photons_per_joule(wavelength_nm: float) -> float:
    """Photons in one joule of light of the given vacuum wavelength: lambda / (h c)."""
    return wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
