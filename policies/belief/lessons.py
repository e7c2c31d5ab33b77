"""What the network is held against: targets in images for the eyes, whole windows for the rest.

A frame costs the eyes some seventy times what it costs belief and head. So the eyes learn from
frames, and belief and head from windows of control steps, from what the eyes saw in them.
"""

import dataclasses
from collections.abc import Mapping

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from hvs_suite.policies.belief import arm
from hvs_suite.policies.belief.belief import BELIEF_SIZE, View, belief_loss
from hvs_suite.policies.belief.eye import sighting_loss
from hvs_suite.policies.belief.network import BEGUN, SET_POINT, BeliefNetwork
from hvs_suite.policies.network import geometry

Parts = dict[str, Tensor]

ACTION_BETA = 0.3
"""Errors of the head's output beyond this count linearly."""
FLANGE_WEIGHT = 0.3
_TURN_LEVER_M = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """B windows of T control steps, each of one episode.

    Attributes:
        memory: Before the first step, (B, k) float64.
        sightings: Camera name to (B, T, 9).
        state: (B, T, 14).
        set_point: Where the arm has been sent before each step, (B, T, 7) rad, float64.
        action: What the demonstrator would do, (B, T, 7).
        place: Of the target, (B, T, 3) m, float64.
        velocity: Of the target, (B, T, 3) m/s, float64.
        slope: x and y of the normal over its z, (B, T, 2), float64.
        goal: Of the tip, (B, T, 3) m.
        felt: Wrench, (B, T, 6); None without.
        counts: False for steps after the end of the episode, (B, T).
    """

    memory: Tensor
    sightings: Mapping[str, Tensor]
    state: Tensor
    set_point: Tensor
    action: Tensor
    place: Tensor
    velocity: Tensor
    slope: Tensor
    goal: Tensor
    felt: Tensor | None
    counts: Tensor


def camera_normals(network: BeliefNetwork, q: Tensor, normal: Tensor) -> dict[str, Tensor]:
    """The target's normal as each camera sees it, by the measured joints.

    Args:
        network: Knows where the cameras are.
        q: Measured joint positions, (B, 7) rad.
        normal: Base frame, (B, 3).

    Returns:
        Camera name to x and y in its optical frame, (B, 2).
    """
    views = network.views(geometry.flange_motion(q.double()))
    turned = {
        name: (view.rotation.transpose(1, 2) @ normal.double()[:, :, None])[:, :2, 0]
        for name, view in views.items()
    }
    return {name: xy.float() for name, xy in turned.items()}


def eye_lesson(
    sightings: Mapping[str, Tensor], truths: Mapping[str, Tensor], normals: Mapping[str, Tensor]
) -> tuple[Tensor, Parts]:
    """Loss of what the eyes make of frames.

    Args:
        sightings: Camera name to (B, 9).
        truths: Camera name to u, v, apparent diameter in image widths, visible 0/1, (B, 4).
        normals: As `camera_normals` returns them.

    Returns:
        Scalar, and the loss of each eye.
    """
    parts = {
        f"{name}_loss": sighting_loss(sighting, truths[name], normals[name])[0]
        for name, sighting in sightings.items()
    }
    return torch.stack(list(parts.values())).sum(), parts


def remembered(network: BeliefNetwork, window: Window) -> Tensor:
    """The memory at each step, its observation in it, (B, T, k) float64."""
    n, length = window.state.shape[:2]
    motion = geometry.flange_motion(window.state[..., :7].reshape(-1, 7).double())
    views = {
        name: View(
            view.origin.reshape(n, length, 3), view.rotation.reshape(n, length, 3, 3), view.tan
        )
        for name, view in network.views(motion).items()
    }
    memory, memories = window.memory, []
    for t in range(length):
        memory = memory.clone()
        memory[:, SET_POINT] = window.set_point[:, t]
        memory[:, BEGUN] = 1.0
        memory = network.remember(
            memory,
            {name: sighting[:, t] for name, sighting in window.sightings.items()},
            window.state[:, t, :7],
            {name: View(v.origin[:, t], v.rotation[:, t], v.tan) for name, v in views.items()},
        )
        memories.append(memory)
    return torch.stack(memories, dim=1)


def window_lesson(network: BeliefNetwork, window: Window) -> tuple[Tensor, Parts]:
    """Loss of belief and head over windows.

    The belief is held against the goal, the head's joint step against the demonstrator's, and where
    that step brings the tip against the way that is left: joint by joint, a tenth too much of a
    fast step is a small error, but a tip that goes astray near the goal is not.

    Args:
        network: What learns.
        window: What it learns from.

    Returns:
        Scalar, and its parts.
    """
    counts = window.counts.flatten()

    def flat(values: Tensor) -> Tensor:
        return values.flatten(0, 1)[counts]

    memory = flat(remembered(network, window))
    state = flat(window.state)
    loss, parts = belief_loss(
        memory[:, :BELIEF_SIZE],
        flat(window.place),
        flat(window.velocity),
        flat(window.slope),
        network.shape.error_scale,
    )
    out = network.decide(
        memory,
        {name: flat(sighting) for name, sighting in window.sightings.items()},
        state,
        None if window.felt is None else flat(window.felt),
    )
    label = network.encode_label(flat(window.action), memory)
    action = F.smooth_l1_loss(out, label, beta=ACTION_BETA)
    tip = arm.tip_of(geometry.flange_motion(state[:, :7]), network.cell.tool_length_m)
    astray = (tip.jacobian @ (network.to_step(out) - network.to_step(label))[:, :, None])[:, :, 0]
    astray = torch.cat([astray[:, :3], _TURN_LEVER_M * astray[:, 3:]], dim=1)
    way = (flat(window.goal) - tip.position).norm(dim=1, keepdim=True)
    scale = 0.04 * network.shape.error_scale + 0.1 * way
    flange = torch.asinh(astray.norm(dim=1, keepdim=True) / scale).mean()
    whole = action + FLANGE_WEIGHT * flange + loss.float()
    named = {f"{name}_loss": part.detach() for name, part in parts.items()}
    return whole, {"action_loss": action.detach(), "flange_loss": flange.detach(), **named}
