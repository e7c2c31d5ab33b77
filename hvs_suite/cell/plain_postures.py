"""Plain postures: the few of a goal's configurations that demonstrations go to, and which of them.

Which of a goal's two thousand configurations is reached soonest changes with every small change of
where the arm is, and a network cannot learn that. It can learn to choose among a few, if it is
shown the way there. The demonstrator (`hvs_suite.datasets.planner`) and the policy's head
(`hvs_suite.policies.belief.arm`) go by the same rule (docs/experiments/simple-ways.md and
elbow-aside.md).
"""

import math

import numpy as np
import numpy.typing as npt

from hvs_suite.cell import robot

FloatArray = npt.NDArray[np.float64]

ELBOWS_RAD = (-math.radians(30.0), 0.0, math.radians(30.0))
"""Places of the elbow on its circle about the line from shoulder to wrist, from straight above: in
the mirror shapes of these three the arm arrives nearly as soon as in the soonest of all."""
CHOSEN_ABOVE_M = 0.08
"""How far above the target, along its normal, the arm would have to come soonest (m). So one that
first looks from above and then comes down goes on in the posture in which it has looked."""
EFFORT_S = 0.01
"""Price of a joint's turn that takes a second at full speed, squared (s). Where the elbow has to
bend, all places of the elbow take the same time."""


def soonest_first(q: FloatArray, postures: FloatArray) -> npt.NDArray[np.intp]:
    """Order of postures by when the slowest joint is there at full speed, A7 left out.

    Args:
        q: Joint angles now, (7,) rad.
        postures: (m, 7) rad.

    Returns:
        Rows of `postures`, (m,).
    """
    turns_s = ((postures - q) / robot.JOINT_SPEED_RAD_S)[:, :6]
    price = np.abs(turns_s).max(axis=1) + EFFORT_S * np.square(turns_s).sum(axis=1)
    return np.argsort(price, kind="stable")
