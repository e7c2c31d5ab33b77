"""What the robot of a cell is: the bare arm, or the arm with a tool, and how it is driven.

Plain data, which imports neither MuJoCo nor Pinocchio: specs name an embodiment, and robot, cell,
kinematics and planners are built for it. Frames: the flange frame has its origin at the flange
face, +z out along the tool axis; the tip lies on that axis.
"""

import dataclasses
import functools
import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

ADAPTER_LENGTH_M = 0.008
"""Height of the plate that carries the tool and the camera's bracket (m)."""
COLLET_LENGTH_M = 0.012
COLLET_RADIUS_M = 0.012
EIH_BESIDE_M = 0.055
"""How far beside the tool's axis the eye in the hand is, against the flange's y axis (m)."""
EIH_AHEAD_M = 0.005
EIH_AIM_M = 0.020
"""Where its optical axis meets the tool's: so far beyond the tip (m)."""


@dataclasses.dataclass(frozen=True)
class Tool:
    """A peg in a collet on the flange, with the eye in hand beside it.

    Attributes:
        peg_diameter_m: Diameter of the peg (m).
        peg_length_m: How far it stands out of the collet (m).
        edge_m: Width of the chamfer at its tip, sideways; twice as much along it (m).
    """

    peg_diameter_m: float = 0.010
    peg_length_m: float = 0.050
    edge_m: float = 0.0001

    @property
    def length_m(self) -> float:
        """From the flange face to the tip (m)."""
        return ADAPTER_LENGTH_M + COLLET_LENGTH_M + self.peg_length_m


@dataclasses.dataclass(frozen=True)
class Embodiment:
    """An arm with what it carries, and how it is driven and computed.

    Attributes:
        tool: What is on the flange, if anything.
        stiffness: Joint stiffness as a share of the position controller's; the damping is that
            times its root, so that the joints settle in the same manner, only slower.
        timestep_s: Physics timestep (s).
        impratio: How much stiffer friction is than normal contact.
        noslip_iterations: Of MuJoCo's further solver against slip, which its GPU port lacks.
    """

    tool: Tool | None = None
    stiffness: float = 1.0
    timestep_s: float = 1.0 / 240.0
    impratio: float = 1.0
    noslip_iterations: int = 5

    @property
    def tool_length_m(self) -> float:
        """From the flange face to the tip (m); 0 without a tool, where the flange is the tip."""
        return 0.0 if self.tool is None else self.tool.length_m

    @property
    def slowness(self) -> float:
        """How many times longer the joints trail their set points than with full stiffness."""
        return 1.0 / math.sqrt(self.stiffness)

    @functools.cached_property
    def hand_eye(self) -> tuple[FloatArray, FloatArray]:
        """Optical frame of the eye in the hand in the flange frame: axes (3, 3), origin (3,) m.

        At the flange's centre, looking along its axis, where there is no tool.
        """
        if self.tool is None:
            return np.eye(3), np.zeros(3)
        tilt = math.atan2(EIH_BESIDE_M, self.tool.length_m + EIH_AIM_M - EIH_AHEAD_M)
        c, s = math.cos(tilt), math.sin(tilt)
        axes = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
        return axes, np.array([0.0, -EIH_BESIDE_M, EIH_AHEAD_M])


BARE_ARM = Embodiment()
"""The arm alone, driven by the stiff position controller."""
