"""What is wrong with angles and depths whose truth is known, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_NEAR_RAD = 0.02  # 3 px of the default rig; the senses of phi differ by 0.08 on easy pairs
_NEAR_DEPTH = 0.5  # relative: a spot that is off by some pixels stays within
_UNITS = {1000.0: "millimetres", 100.0: "centimetres"}


def phi_fault(angles: Sequence[tuple[float, str, dict[str, float]]]) -> str:
    """What is wrong with angles (phi in radians, its convention, the true angles by convention); "" if nothing is.

    The convention "outline" is none of the truth's and is left alone.
    """
    known = [(phi, convention, truth) for phi, convention, truth in angles if convention in truth]
    if not known:
        return ""
    off = {
        name: float(np.median([abs(phi - truth[name]) for phi, _, truth in known]))
        for name in ("ray", "normal", "incidence")
    }
    said = float(np.median([abs(phi - truth[convention]) for phi, convention, truth in known]))
    if said <= _NEAR_RAD:
        return ""
    best, convention = min(off, key=lambda name: off[name]), known[0][1]
    if off[best] <= _NEAR_RAD:
        return f"phi_rad is the angle '{best}', not '{convention}': set phi_convention='{best}'"
    if float(np.median([abs(phi - 2.0 * truth["ray"]) for phi, _, truth in known])) <= 2.0 * _NEAR_RAD:
        return "phi_rad is theta, the ray's angle from the downward vertical: phi is half of it"
    return f"phi_rad is off by {said:.2g} rad (median) from the angle '{convention}'"


def depth_fault(depths: Sequence[tuple[float, float]]) -> str:
    """What is wrong with pairs (depth, true depth), metres; "" if nothing is."""
    if not depths:
        return ""
    ratio = float(np.median([depth / truth for depth, truth in depths]))
    if abs(ratio - 1.0) <= _NEAR_DEPTH:
        return ""
    for factor, unit in _UNITS.items():
        if abs(ratio / factor - 1.0) <= _NEAR_DEPTH:
            return f"depth_m is in {unit}: metres are needed"
    return f"depth_m is {ratio:.2g} times the true depth (median)"
