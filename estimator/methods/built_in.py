"""A method that comes with phibench, and what it can be asked."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from phibench.estimator.methods.linear import KINDS, kind_of
from phibench.estimator.seat.pair import Answer, Method, Pair, Spot


@dataclass(frozen=True)
class BuiltIn:
    """One built-in method; call it like any method. A pair that it cannot take gets a status, never an exception.

    Parameters
    ----------
    name : str
    function : Method
    description : str
        One line.
    source : str
        Where the idea comes from.
    accepts : tuple of str
        Kinds of images, of `linear.KINDS`.
    needs_off : bool
        Whether it cannot do without laser-off frames.
    needs_boxes : bool
        Whether it cannot do without region hints.
    package : str
        What must be installed besides phibench; "" for nothing.
    """

    name: str
    function: Method
    description: str
    source: str
    accepts: tuple[str, ...] = KINDS
    needs_off: bool = False
    needs_boxes: bool = False
    package: str = ""

    @property
    def installed(self) -> bool:
        """Whether its package can be imported."""
        return not self.package or find_spec(self.package) is not None

    def refusal(self, pair: Pair) -> str:
        """Why this pair cannot be taken; "" if it can."""
        kind = kind_of(pair.card)
        if not self.installed:
            return f"install {self.package}"
        if kind not in self.accepts:
            return f"takes {', '.join(self.accepts)}, not {kind}"
        if self.needs_off and (pair.down_off is None or pair.up_off is None):
            return "needs laser-off frames"
        if self.needs_boxes and (pair.box_down is None or pair.box_up is None):
            return "needs region hints"
        return ""

    def __call__(self, pair: Pair) -> Answer:
        """Answer for a pair, or a status that says why there is none."""
        why = self.refusal(pair)
        return Answer(Spot.missing(why), Spot.missing(why)) if why else self.function(pair)
