"""The loss of what the head says, joint by joint and at the tip."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from hvs_suite.policies.belief import arm, geometry
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork, Decision

HUBER_BETA = 0.3
TIP_WEIGHT = 0.3
CHOICE_WEIGHT = 0.1
CHOICE_SCALE = 0.1
"""Mean error of a joint, as it is encoded, by which a proposal is e times less likely."""
LEVER_M = 0.2
"""Angles weigh like the offsets that they cause so far away."""


def action_loss(out: Tensor, label: Tensor) -> Tensor:
    """Huber loss between the head's output and the encoded label, both (n, 7)."""
    return F.smooth_l1_loss(out, label, beta=HUBER_BETA)


def choice_loss(decision: Decision, label: Tensor) -> Tensor:
    """How unlikely the label is where each proposal is as likely as the head weighs it.

    The loss of a mean hardly says which proposal would have been right once the head is sure of
    another one. This one says it all the more.

    Args:
        decision: Of n frames.
        label: What the head should have said, (n, 7).
    """
    misses = (decision.proposals.detach() - label[:, None]).abs().mean(dim=2) / CHOICE_SCALE
    return -torch.logsumexp(decision.weights.log_softmax(dim=1) - misses, dim=1).mean()


def tip_loss(network: BeliefNetwork, out: Tensor, label: Tensor, q: Tensor, goal: Tensor) -> Tensor:
    """Loss of where a joint step brings the tip, against the way that is left to go.

    Joint by joint, a tenth too much of a fast step is a small error. But the arm comes down on the
    target in steps of a decimetre, one joint against another, and what counts is how far the tip
    goes astray compared with how far it still has to go.

    Args:
        network: The network.
        out: What its head says, (n, 7).
        label: What it should have said, (n, 7).
        q: Measured joint positions, (n, 7) rad.
        goal: Of the tip, (n, 3) m.

    Returns:
        Scalar, logarithmic.
    """
    tip = arm.tip_of(geometry.flange_motion(q[:, :N_JOINTS]), network.cell.tool_length_m)
    error = network.to_step(out) - network.to_step(label)
    astray = (tip.jacobian @ error[:, :, None])[:, :, 0]
    astray = torch.cat([astray[:, :3], LEVER_M * astray[:, 3:]], dim=1)
    distance = (goal - tip.position).norm(dim=1, keepdim=True)
    # A twenty-fifth of the scale counts even at the goal.
    scale = 0.04 * network.shape.error_scale + 0.1 * distance
    return torch.asinh(astray.norm(dim=1, keepdim=True) / scale).mean()
