"""What a study is: a question, settings that a TOML file fills, and a function from data sets to a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import BaseModel, ConfigDict

from phibench.estimator.studies.material import Material
from phibench.estimator.studies.result import Result


class Settings(BaseModel):
    """Settings of a study; each study has its own, frozen and strict, with ranges and descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Study(Generic[S]):
    """A study.

    Parameters
    ----------
    name : str
        As in `phibench study NAME`; its settings are in `NAME.toml` beside the code.
    title : str
        Heading of its section in the report.
    question : str
        What it answers, one sentence.
    settings : type
    run : callable
        From settings and material to the result; the same settings and data sets give the same result.
    """

    name: str
    title: str
    question: str
    settings: type[S]
    run: Callable[[S, Material], Result]
