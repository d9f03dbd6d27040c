"""A vector that was measured."""

from __future__ import annotations

from dataclasses import dataclass

from phibench.scenes.frames import Array


@dataclass(frozen=True)
class Measured:
    """A sphere centre or a vertical that was measured, with its covariance."""

    value: Array
    covariance: Array
