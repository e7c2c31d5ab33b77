"""Metrics: what is measured of an episode, and which bounds make a success."""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class Metric:
    """One figure.

    Attributes:
        name: Key in ``info["errors"]``, in results and in datasets; ends with its unit.
        unit: ``mm``, ``deg``, ``%``, ``N``, or empty for a count.
        title: As people read it, such as ``lateral error``.
        bound: Largest value of a success; None where the figure is only reported.
        over: ``step``: measured at the end of each control step. ``episode``: kept over the
            episode so far.
        is_limit: Whether a breach of the bound ends the episode at once: an overload.
    """

    name: str
    unit: str
    title: str
    bound: float | None = None
    over: Literal["step", "episode"] = "step"
    is_limit: bool = False

    @property
    def label(self) -> str:
        """Title and unit, as a table's heading."""
        return f"{self.title}, {self.unit}" if self.unit else self.title
