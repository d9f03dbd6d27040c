"""Mirrors with an error of form."""

from __future__ import annotations

from phibench.scenes.form_error import HARMONICS, Form
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig


def formed(form: Form, **more: float) -> Rig:
    """Default rig with a form and what else is wrong."""
    values = {name: getattr(form, name) for name in HARMONICS}
    return default_rig().perturbed(Misalignment(**values, **more))
