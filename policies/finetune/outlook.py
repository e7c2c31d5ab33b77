"""What a command leads to, by the arm's own kinematics: what a critic need not learn.

The worth of a command lies in millimetres at the end of a metre of arm. The kinematics of seven
joints at that precision are more than a critic learns in an hour, and the actor can be no better
than the critic's slope. So critics read the errors that a command leads to, and their slope comes
through the kinematics.
"""

import torch
from torch import Tensor

from hvs_suite.cell.robot import LAG_S
from hvs_suite.policies.finetune.stage import COMING, GOAL, JOINTS, NORMAL, SENT
from hvs_suite.policies.network import geometry
from hvs_suite.policies.network.network import CONTROL_PERIOD_S, N_JOINTS, HvsNetwork

OUTLOOK_SIZE = 20
FINE = 25.0
"""Lengths are also read on a scale that is finer by this factor: inside the tolerance."""


class Outlook:
    """Errors where a command brings the arm in its control step, and where the arm goes from there.

    The set point moves as fast as the joints may, from where all commands so far have sent it. The
    arm trails it, by a third of a step that goes on: who saw the set point alone would never learn
    to send it ahead. With latency both are a step or two ahead of what is.

    Args:
        network: The base.
        bound: The most that an action of 1 adds to its output.
    """

    def __init__(self, network: HvsNetwork, bound: float) -> None:
        self._network = network
        self._bound = bound
        lag = torch.as_tensor(LAG_S).float()
        # Shares of the last step, and of what was left to go before it; see `after_commands`.
        self._left = (-CONTROL_PERIOD_S / lag).exp()
        self._trail = (1.0 - self._left) * lag / CONTROL_PERIOD_S

    def __call__(self, features: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
        """Look ahead.

        Args:
            features: `Decision.features` of the base, which end in its output, (B, n).
            privileged: As `privileged_state` gives it, (B, m).
            action: Shares of the bound, (B, 7).

        Returns:
            (B, 20), each as asinh(x / error scale), at the end of the control step and once the arm
            is where the set point is then: from flange to goal (3), the rotation vector from flange
            axis to inward normal (3), and the length of either, also on a finer scale.
        """
        network = self._network
        # A hair more than it can: at the very end of a clamp's range rounding decides on its slope.
        longest = network.joint_speed * CONTROL_PERIOD_S * (1.0 + 1e-4)
        step = network.to_step(features[:, -N_JOINTS:] + self._bound * action)
        places = (privileged[:, which] * network.joint_range for which in (JOINTS, COMING, SENT))
        joints, coming, sent = places
        origin = sent if network.shape.from_set_point else joints
        turn = (origin + step - sent).clamp(-longest, longest)
        ahead = sent + turn
        arm = ahead - self._trail * turn + self._left * (coming - sent)
        errors = torch.cat([self._errors(at, privileged) for at in (arm, ahead)], dim=1)
        return torch.asinh(errors / network.shape.error_scale)

    def _errors(self, joints: Tensor, privileged: Tensor) -> Tensor:
        """Errors at joint positions (B, 7), (B, 10), in m and rad."""
        motion = geometry.flange_motion(joints)
        way = privileged[:, GOAL] - motion.position
        turn = torch.linalg.cross(motion.rotation[:, :, 2], -privileged[:, NORMAL], dim=1)
        # Where the length is 0 the norm has no slope.
        lengths = [(each.square().sum(dim=1, keepdim=True) + 1e-12).sqrt() for each in (way, turn)]
        return torch.cat([way, turn, *lengths, *(FINE * length for length in lengths)], dim=1)
