"""Probability distributions of a recipe's numbers, and `Table`, the strict base class of all recipe tables.

A value is the quantile of a number u in [0, 1), so any sequence of points in the unit interval can be used.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, get_origin

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from phibench.scenes.frames import Array
from phibench.scenes.validation import allowed_text, schema_node


class Table(BaseModel):
    """A table of a recipe: no unknown keys, no silent conversions, no NaN or infinity, immutable."""

    # validators are built at their first use: many commands import the tables and read no recipe
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)
    later: ClassVar[Collection[str]] = ()
    """Keys that came later: a recipe that does not give them keeps the hash that it had before there were any."""

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, serialised: SerializerFunctionWrapHandler) -> dict[str, Any]:
        document: dict[str, Any] = serialised(self)
        fields = type(self).model_fields
        later = {key: fields[key].get_default(call_default_factory=True) for key in self.later}
        return {key: x for key, x in document.items() if key not in later or x != later[key]}


KINDS = ("uniform", "log_uniform", "normal", "choice")
Pair = Annotated[tuple[float, ...], Field(strict=False, min_length=2, max_length=2)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.]*$", max_length=48)]


class DistributionTable(Table):
    """A distribution of one number: exactly one of `KINDS`; `clip` belongs to `normal`."""

    uniform: Pair | None = Field(default=None, description="[low, high]: every value alike")
    log_uniform: Pair | None = Field(default=None, description="[low, high], above 0: every ratio alike")
    normal: Pair | None = Field(default=None, description="[mean, sigma], cut off at clip")
    clip: Pair | None = Field(
        default=None, validate_default=True, description="[low, high] of a normal distribution, which is cut off there"
    )
    choice: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="numbers that are equally probable"
    )

    @field_validator("uniform", "log_uniform", "clip")
    @classmethod
    def _rises(cls, pair: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        if pair is not None and not pair[0] < pair[1]:
            raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is not allowed; give a low that is below the high")
        if pair is not None and info.field_name == "log_uniform" and pair[0] <= 0.0:
            raise ValueError(f"starts at {pair[0]:g}; give a low above 0")
        return pair

    @field_validator("normal")
    @classmethod
    def _spreads(cls, normal: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if normal is not None and normal[1] <= 0.0:
            raise ValueError(
                f"sigma = {normal[1]:g} is not allowed; give a sigma above 0, or a plain number for a constant"
            )
        return normal

    @field_validator("clip")
    @classmethod
    def _belongs(cls, clip: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        normal = info.data.get("normal", ())  # (): it is given and faulty, which is told by itself
        if normal is not None and clip is None:
            raise ValueError("missing; a normal distribution needs clip = [low, high], where it is cut off; add it")
        if normal is None and clip is not None:
            raise ValueError("is for a normal distribution only; give normal = [mean, sigma] or remove it")
        if normal and clip and not clip[0] <= normal[0] <= clip[1]:
            raise ValueError(f"[{clip[0]:g}, {clip[1]:g}] leaves out the mean {normal[0]:g}; give one around it")
        return clip

    @model_validator(mode="after")
    def _is_one(self) -> DistributionTable:
        if len(self.kinds) != 1:
            given = ", ".join(self.kinds) or "none"
            raise ValueError(
                f"exactly one of {', '.join(KINDS)} is needed (a plain number is a choice of one); given: {given}"
            )
        return self

    @property
    def kinds(self) -> list[str]:
        """Those of `KINDS` that are given; one in a sound table."""
        return [kind for kind in KINDS if getattr(self, kind) is not None]

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value."""
        values = self.uniform or self.log_uniform or self.clip or self.choice or ()
        return min(values), max(values)


def one_number(given: object) -> object:
    """A plain number is a choice of one."""
    return {"choice": [given]} if isinstance(given, int | float) and not isinstance(given, bool) else given


def one_name(given: object) -> object:
    """A plain name is a choice of one."""
    return {"choice": [given]} if isinstance(given, str) else given


def names_of(name: Any) -> Any:
    """Type of a choice of names of a type such as ``Literal["a", "b"]``, or None."""
    names: Any = Annotated[tuple[name, ...], Field(strict=False, min_length=1)]
    column: Any = (names, Field(description="names that are equally probable"))
    return Annotated[create_model("NameChoice", __base__=Table, choice=column) | None, BeforeValidator(one_name)]


Distribution = Annotated[
    DistributionTable, BeforeValidator(one_number, json_schema_input_type=DistributionTable | float)
]


def is_whole(table: DistributionTable) -> DistributionTable:
    """Return a distribution of whole numbers; any other is a fault."""
    if table.choice is None or any(value != int(value) for value in table.choice):
        raise ValueError("must be a whole number or a choice of whole numbers, such as { choice = [60, 75, 90] }")
    return table


class ValuesOf:
    """Validator of distributions whose values are all of a type, such as ``Annotated[float, Field(gt=0.0)]``.

    The JSON schema tells the range of the values by the key `values`.
    """

    def __init__(self, kind: Any, whole: bool = False) -> None:
        self._kind, self._whole = kind, whole

    @cached_property  # at its first use: a recipe has a hundred of them, and uses few
    def _adapter(self) -> TypeAdapter[Any]:
        return TypeAdapter(self._kind)

    @cached_property
    def _words(self) -> str:
        return allowed_text(schema_node(self._adapter.json_schema(), ()))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Schema of the annotated type, and the check after it."""
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """JSON schema of the annotated type, and the range of its values."""
        words = self._words.replace("a number", "a whole number") if self._whole else self._words
        return {**handler(core), "values": words}

    def _checked(self, table: DistributionTable) -> DistributionTable:
        if faulty := [f"{value:g}" for value in dict.fromkeys(table.support) if not self._is_sound(value)]:
            raise ValueError(f"reaches {' and '.join(faulty)}, which is not allowed; stay with {self._words}")
        return is_whole(table) if self._whole else table

    def _is_sound(self, value: float) -> bool:
        try:
            self._adapter.validate_python(value)
        except ValidationError:  # its sentence speaks of the value; ours tells the whole distribution
            return False
        return True


def drawn_fields(table: type[Table], keys: Iterable[str]) -> dict[str, Any]:
    """Fields of `create_model`: a distribution, in its range or of its names, of each of some keys of a table."""
    fields = {}
    for key in keys:
        given = table.model_fields[key]
        kind = Annotated[given.annotation, Field(), *given.metadata]  # type: ignore[name-defined]
        is_name = get_origin(given.annotation) is Literal
        drawn: Any = names_of(given.annotation) if is_name else Annotated[Distribution, ValuesOf(kind)] | None
        fields[key] = (drawn, Field(default=None, description=given.description))
    return fields


class TargetChoice(Table):
    """Boards to draw from, with equal probability."""

    choice: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="names from [[targets]], equally probable"
    )


Targets = Annotated[TargetChoice | None, BeforeValidator(one_name, json_schema_input_type=TargetChoice | str | None)]


# `scipy.stats` has these quantile functions too, and is not used: importing it takes a second, and its truncated normal
# rounds differently (5 of 500 principal points of `bench-dev` by one unit in the last place).


def quantile(table: DistributionTable, u: Array) -> Array:
    """Values for parts u of the probability, shape of u, each in [0, 1).

    A clipped normal distribution is truncated: its density keeps its shape between the clips and is 0 outside.
    """
    low, high = table.support
    return np.clip(_quantile(table, np.asarray(u, float)), low, high)  # rounding must not lead beyond the ends


def _quantile(table: DistributionTable, u: Array) -> Array:
    if table.uniform is not None:
        low, high = table.uniform
        return low + u * (high - low)
    if table.log_uniform is not None:
        low, high = np.log(table.log_uniform)
        return np.exp(low + u * (high - low))
    if table.normal is not None and table.clip is not None:
        from scipy.special import ndtr, ndtri  # here: most commands read recipes, and few draw

        mean, sigma = table.normal
        low, high = ndtr((np.array(table.clip) - mean) / sigma)
        return np.asarray(mean + sigma * ndtri(low + u * (high - low)), float)
    return np.array(pick(table.choice or (), u))


def pick(values: Sequence[Any], u: Array) -> list[Any]:
    """Equally probable values for parts u of the probability."""
    return [values[min(int(x * len(values)), len(values) - 1)] for x in u]
