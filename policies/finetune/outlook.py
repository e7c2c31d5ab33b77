"""What a command leads to, by the arm's own kinematics: what a critic need not learn.

The worth of a command lies in millimetres at the end of a metre of arm. The kinematics of seven
joints at that precision are more than a critic learns in an hour, and the actor can be no better
than the critic's slope. So critics read the errors that a command leads to, and their slope comes
through the kinematics.
"""

import torch
from torch import Tensor

from hvs_suite.policies.finetune.stage import GOAL, JOINTS, NORMAL, SENT
from hvs_suite.policies.hvs import geometry
from hvs_suite.policies.hvs.network import CONTROL_PERIOD_S, N_JOINTS, HvsNetwork

OUTLOOK_SIZE = 10
FINE = 25.0
"""Lengths are also read on a scale that is finer by this factor: inside the tolerance."""


class Outlook:
    """Errors where the set point goes by a command, once the joints have come there.

    The set point moves as fast as the joints may, from where all commands so far have sent it. With
    latency that is a step or two ahead of the arm.

    Args:
        network: The base.
        bound: The most that an action of 1 adds to its output.
    """

    def __init__(self, network: HvsNetwork, bound: float) -> None:
        self._network = network
        self._bound = bound

    def __call__(self, features: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
        """Look ahead.

        Args:
            features: `Decision.features` of the base, which end in its output, (B, n).
            privileged: As `privileged_state` gives it, (B, m).
            action: Shares of the bound, (B, 7).

        Returns:
            (B, 10), each as asinh(x / error scale): from flange to goal (3), the rotation vector
            from flange axis to inward normal (3), and the length of either, also on a finer scale.
        """
        network = self._network
        # A hair more than it can: at the very end of a clamp's range rounding decides on its slope.
        longest = network.joint_speed * CONTROL_PERIOD_S * (1.0 + 1e-4)
        step = network.to_step(features[:, -N_JOINTS:] + self._bound * action)
        joints, sent = (privileged[:, which] * network.joint_range for which in (JOINTS, SENT))
        origin = sent if network.shape.from_set_point else joints
        motion = geometry.flange_motion(sent + (origin + step - sent).clamp(-longest, longest))
        way = privileged[:, GOAL] - motion.position
        turn = torch.linalg.cross(motion.rotation[:, :, 2], -privileged[:, NORMAL], dim=1)
        # Where the length is 0 the norm has no slope.
        lengths = [(each.square().sum(dim=1, keepdim=True) + 1e-12).sqrt() for each in (way, turn)]
        errors = torch.cat([way, turn, *lengths, *(FINE * length for length in lengths)], dim=1)
        return torch.asinh(errors / network.shape.error_scale)
