"""Feeling for a hole: a spiral search of the tip over a level face, by wrench and measured joints.

This is a plain method on purpose, like `hvs_suite.tasks.shared.detection`. The certificate uses it
to prove that a hole can be found although no picture shows it, and the ``servo`` baseline uses it
to solve the task. It knows only measurements: where the tip is, and the wrench at the tool.

The tip comes down until it is pressed against the face, then goes along an Archimedean spiral at a
light, regulated force. Once it drops below the face it is in the mouth: it follows where the mouth
leads it, and goes down.
"""

import dataclasses
import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Search:
    """How the search goes.

    Attributes:
        pitch_m: Distance of neighbouring turns (m): less than the mouth catches.
        step_m: Way along the spiral in a control step (m).
        widest_m: Radius at which it begins anew, from the middle (m); 0 for pushing straight down.
        press_n: Force that the tip keeps on the face (N).
        guard_n: Force above which it does not go deeper (N).
        down_m: Step down onto the face (m).
        in_m: Step down in the hole (m).
    """

    pitch_m: float
    step_m: float
    widest_m: float
    press_n: float = 2.0
    guard_n: float = 15.0
    down_m: float = 0.001
    in_m: float = 0.0025


_WIDEST_SIGMA = 2.8
"""Two directions, each cut at two sigma."""
_SIGHT_MM = 1.0
_PITCH = 1.6
_STEP = 1.3
"""Distance of turns, and way in a control step, in units of what the mouth catches."""
_TOUCHED_N = 2.0
_IN_M = 0.00012
"""So far below where it was first pressed, the tip is in the mouth."""
_COMPLIANCE_M_N = 0.0002
"""How far the set point is lowered for each newton that is missing."""
_LARGEST_PRESS_M = 0.001
_FOLLOW = 0.3
"""Share of the tip's distance from where it shall be that a control step adds to the set point."""
_MAX_LEAD_M = 0.003
_FRICTION_M_N = 0.0004
"""How far friction holds the tip back for each newton that it is pressed with."""


def search_of(clearance_mm: float, chamfer_mm: float, noise_mm: float, searches: bool) -> Search:
    """The search that suits a hole.

    Args:
        clearance_mm: By how much its radius is larger than the peg's (mm).
        chamfer_mm: Width of its chamfer (mm).
        noise_mm: Standard deviation of where it is (mm a direction); sight adds to that.
        searches: False for pushing straight down.
    """
    catch_m = 0.001 * (clearance_mm + chamfer_mm)
    widest_m = 0.001 * math.hypot(_WIDEST_SIGMA * noise_mm, _SIGHT_MM) if searches else 0.0
    return Search(pitch_m=_PITCH * catch_m, step_m=_STEP * catch_m, widest_m=widest_m)


class HoleSearch:
    """One search; positions of the tip in the frame that encoders show, the face level.

    Args:
        search: How it goes.
        mouth: Where the middle of the mouth is believed to be, (3,) m.
        set_point: Where the set point's tip is now, (3,) m.
    """

    def __init__(self, search: Search, mouth: FloatArray, set_point: FloatArray) -> None:
        self._search = search
        self._mouth = mouth
        self._set_point = np.array([*mouth[:2], set_point[2]])
        self._face_m: float | None = None
        self._turn = 0.0
        self._wanted: FloatArray = mouth[:2].copy()
        self._lead: FloatArray = np.zeros(2)

    @property
    def is_pressed(self) -> bool:
        """Whether the tip has met the face."""
        return self._face_m is not None

    def next_set_point(self, tip: FloatArray, force_n: float) -> FloatArray:
        """Where the set point's tip shall be at the end of the control step, (3,) m.

        Args:
            tip: Where the tip is, (3,) m.
            force_n: What presses on it against its axis (N).
        """
        search = self._search
        if self._face_m is None and force_n > _TOUCHED_N:
            self._face_m = float(tip[2])
        face_m = self._mouth[2] - 0.002 if self._face_m is None else self._face_m
        if tip[2] < face_m - _IN_M:
            self._go_in(tip, force_n)
        elif self._face_m is None or not search.widest_m:
            if force_n < search.guard_n:
                self._set_point[2] -= search.down_m
        else:
            self._go_round(tip, force_n)
        return self._set_point.copy()

    def _go_in(self, tip: FloatArray, force_n: float) -> None:
        """Follow the mouth sideways, and go down."""
        self._set_point[:2] += _FOLLOW * (tip[:2] - self._set_point[:2])
        if force_n < self._search.guard_n:
            self._set_point[2] -= self._search.in_m

    def _go_round(self, tip: FloatArray, force_n: float) -> None:
        """Go on along the spiral, keeping the force."""
        search = self._search
        self._lead += _FOLLOW * (self._wanted - tip[:2])
        self._lead *= min(1.0, _MAX_LEAD_M / max(float(np.linalg.norm(self._lead)), 1e-12))
        growth = search.pitch_m / (2.0 * math.pi)
        self._turn += search.step_m / math.hypot(growth * self._turn, growth)
        if growth * self._turn > search.widest_m:
            self._turn = 0.0
        c, s = math.cos(self._turn), math.sin(self._turn)
        radius = growth * self._turn
        self._wanted = self._mouth[:2] + radius * np.array([c, s])
        along = np.array([growth * c - radius * s, growth * s + radius * c])
        along *= _FRICTION_M_N * search.press_n / float(np.linalg.norm(along))
        self._set_point[:2] = self._wanted + along + self._lead
        lower = _COMPLIANCE_M_N * (search.press_n - force_n)
        self._set_point[2] -= min(max(lower, -_LARGEST_PRESS_M), _LARGEST_PRESS_M)
