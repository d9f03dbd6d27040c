"""What every table of a recipe is.

Distributions of a recipe: what may be drawn, and which value belongs to which part of the probability.

A value is the quantile of a number u in [0, 1), so that any sequence of points in the unit interval can be used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from scipy.special import ndtr, ndtri

from phibench.scenes.frames import Array


class Table(BaseModel):
    """A table of a recipe: no unknown keys, no silent conversions, no NaN or infinity, immutable."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


KINDS = ("uniform", "log_uniform", "normal", "choice")
Pair = Annotated[tuple[float, ...], Field(strict=False, min_length=2, max_length=2)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.]*$", max_length=48)]


class DistributionTable(Table):
    """A distribution of one number: exactly one of `KINDS`; `clip` belongs to `normal`."""

    uniform: Pair | None = Field(default=None, description="[low, high]: every value alike")
    log_uniform: Pair | None = Field(default=None, description="[low, high], above 0: every ratio alike")
    normal: Pair | None = Field(default=None, description="[mean, sigma], cut off at clip")
    clip: Pair | None = Field(default=None, description="[low, high] of a normal distribution, which is cut off there")
    choice: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="numbers that are equally probable"
    )

    @property
    def kinds(self) -> list[str]:
        """Those of `KINDS` that are given; one in a sound table."""
        return [kind for kind in KINDS if getattr(self, kind) is not None]


def one_number(given: object) -> object:
    """A plain number is a choice of one."""
    return {"choice": [given]} if isinstance(given, int | float) and not isinstance(given, bool) else given


def one_name(given: object) -> object:
    """A plain name is a choice of one."""
    return {"choice": [given]} if isinstance(given, str) else given


Distribution = Annotated[
    DistributionTable, BeforeValidator(one_number, json_schema_input_type=DistributionTable | float)
]


class TargetChoice(Table):
    """Boards to draw from, with equal probability."""

    choice: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="names from [[targets]], equally probable"
    )


Targets = Annotated[TargetChoice | None, BeforeValidator(one_name, json_schema_input_type=TargetChoice | str | None)]


def distribution_faults(table: DistributionTable) -> Iterator[tuple[str, str]]:
    """Key ("" for the whole) and text of each fault between the keys of a distribution."""
    if len(table.kinds) != 1:
        given = ", ".join(table.kinds) or "none"
        yield "", f"exactly one of {', '.join(KINDS)} is needed (a plain number is a choice of one); given: {given}"
    for key in ("uniform", "log_uniform", "clip"):
        low, high = getattr(table, key) or (0.0, 1.0)
        if not low < high:
            yield key, f"[{low:g}, {high:g}] is not allowed; give a low that is below the high"
    if table.log_uniform is not None and table.log_uniform[0] <= 0.0:
        yield "log_uniform", f"starts at {table.log_uniform[0]:g}; give a low above 0"
    yield from _normal_faults(table)


def _normal_faults(table: DistributionTable) -> Iterator[tuple[str, str]]:
    if table.normal is None:
        if table.clip is not None:
            yield "clip", "is for a normal distribution only; give normal = [mean, sigma] or remove it"
        return
    mean, sigma = table.normal
    if sigma <= 0.0:
        yield "normal", f"sigma = {sigma:g} is not allowed; give a sigma above 0, or a plain number for a constant"
    if table.clip is None:
        yield "", "a normal distribution needs clip = [low, high], where it is cut off; add it"
    elif table.clip[0] < table.clip[1] and not table.clip[0] <= mean <= table.clip[1]:
        yield "clip", f"[{table.clip[0]:g}, {table.clip[1]:g}] leaves out the mean {mean:g}; give one around it"


def support(table: DistributionTable) -> tuple[float, float]:
    """Smallest and largest value that a sound distribution gives."""
    values = table.uniform or table.log_uniform or table.clip or table.choice or ()
    return min(values), max(values)


def quantile(table: DistributionTable, u: Array) -> Array:
    """Values of a sound distribution for parts u of the probability, shape of u, each in [0, 1).

    A clipped normal distribution is truncated: its density keeps its shape between the clips and is 0 outside.
    """
    low, high = support(table)
    return np.clip(_quantile(table, np.asarray(u, float)), low, high)  # rounding must not lead beyond the ends


def _quantile(table: DistributionTable, u: Array) -> Array:
    if table.uniform is not None:
        low, high = table.uniform
        return low + u * (high - low)
    if table.log_uniform is not None:
        low, high = np.log(table.log_uniform)
        return np.exp(low + u * (high - low))
    if table.normal is not None and table.clip is not None:
        mean, sigma = table.normal
        low, high = ndtr((np.array(table.clip) - mean) / sigma)
        return np.asarray(mean + sigma * ndtri(low + u * (high - low)), float)
    return np.array(pick(table.choice or (), u))


def pick(values: Sequence[Any], u: Array) -> list[Any]:
    """Equally probable values for parts u of the probability."""
    return [values[min(int(x * len(values)), len(values) - 1)] for x in u]
