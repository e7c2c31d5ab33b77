"""Lessons: frames for the eyes, windows of control steps for belief and head.

A frame costs the eyes some seventy times what it costs belief and head. So the eyes learn from
frames, and belief and head from windows, from what the eyes saw in them.
"""

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from hvs_suite.policies.belief import geometry
from hvs_suite.policies.belief.belief import BELIEF_SIZE, belief_loss
from hvs_suite.policies.belief.control_loss import (
    CHOICE_WEIGHT,
    TIP_WEIGHT,
    action_loss,
    choice_loss,
    tip_loss,
)
from hvs_suite.policies.belief.eye import Seen, sighting_loss
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.recorded import Recorded

Parts = dict[str, Tensor]


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """B windows of T control steps, each of one episode.

    Attributes:
        memory: Before the first step, (B, k) float64.
        sightings: Camera name to (B, T, 9).
        state: (B, T, 14).
        action: What the demonstrator would do, (B, T, 7).
        truth: Of each step, (B, T).
        felt: Wrench, (B, T, 6); None without.
        counts: False for steps after the end of the episode, (B, T).
    """

    memory: Tensor
    sightings: Mapping[str, Tensor]
    state: Tensor
    action: Tensor
    truth: Recorded
    felt: Tensor | None
    counts: Tensor


def eye_lesson(
    network: BeliefNetwork, seen: Mapping[str, Seen], q: Tensor, truth: Recorded
) -> tuple[Tensor, Parts]:
    """Loss of what the eyes make of frames.

    Args:
        network: Knows where the cameras are.
        seen: By camera name, where the eyes are.
        q: Measured joint positions, (B, 7) rad.
        truth: Of the frames.

    Returns:
        Scalar, and the loss of each eye.
    """
    parts = {}
    device = network.eyes_device
    for name, normal in facing(network, q, truth).items():
        target = truth.targets[name].to(device)
        loss, _ = sighting_loss(seen[name], target, normal.to(device))
        parts[f"{name}_loss"] = loss
    return torch.stack(list(parts.values())).sum(), parts


def facing(network: BeliefNetwork, q: Tensor, truth: Recorded) -> dict[str, Tensor]:
    """How the targets face the cameras: what eyes should say of the slope.

    Args:
        network: Knows where the cameras are.
        q: Measured joint positions, (B, 7) rad.
        truth: Of the frames.

    Returns:
        Camera name to x and y of the normal in its optical frame, (B, 2).
    """
    normal = truth.goal_normal.double()[:, :, None]
    views = network.views(geometry.flange_motion(q.double()))
    return {
        name: (view.rotation.transpose(1, 2) @ normal)[:, :2, 0].float()
        for name, view in views.items()
    }


def remembered(network: BeliefNetwork, window: Window) -> Tensor:
    """The memory at each step, its observation in it, (B, T, k) float64."""
    q, length = window.state[..., :N_JOINTS], window.counts.shape[1]
    views = network.views(geometry.flange_motion(q.flatten(0, 1).double()))
    sightings = {name: sighting.flatten(0, 1) for name, sighting in window.sightings.items()}
    rays = [ray.steps(length) for ray in network.belief.rays(sightings, views)]
    memory, memories = window.memory, []
    for t in range(length):
        memory = network.sent_on(memory, window.truth.set_point[:, t].double())
        memory = network.remember(
            memory,
            {name: sighting[:, t] for name, sighting in window.sightings.items()},
            q[:, t],
            [steps[t] for steps in rays],
        )
        memories.append(memory)
    return torch.stack(memories, dim=1)


def window_lesson(network: BeliefNetwork, window: Window) -> tuple[Tensor, Parts]:
    """Loss of belief and head over windows.

    Args:
        network: What learns; no gradient reaches its eyes.
        window: What it learns from.

    Returns:
        Scalar, and its parts.
    """
    counts = window.counts
    memory, state = remembered(network, window)[counts], window.state[counts]
    truth = window.truth.at(counts)
    normal = truth.goal_normal.double()
    believed, of_belief = belief_loss(
        memory[:, :BELIEF_SIZE],
        truth.goal_position.double() - network.belief.standoff * normal,
        truth.goal_velocity.double(),
        normal[:, :2] / normal[:, 2:],
        network.shape.error_scale,
    )
    decision = network.decide(
        memory,
        {name: sighting[counts] for name, sighting in window.sightings.items()},
        state,
        None if window.felt is None else window.felt[counts],
    )
    label = network.encode_label(window.action[counts], memory)
    action = action_loss(decision.out, label)
    astray = tip_loss(network, decision.out, label, state, truth.goal_position)
    choice = choice_loss(decision, label)
    parts = {"action_loss": action, "tip_loss": astray, "choice_loss": choice}
    parts |= {f"belief_{name}_loss": part.float() for name, part in of_belief.items()}
    return action + TIP_WEIGHT * astray + CHOICE_WEIGHT * choice + believed.float(), parts
