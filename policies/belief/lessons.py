"""Lessons: frames for the eyes, windows of control steps for belief and head.

A frame costs the eyes some seventy times what it costs belief and head. So the eyes learn from
frames, and belief and head from windows, from what the eyes saw in them.
"""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief import geometry
from hvs_suite.policies.belief.belief import BELIEF_SIZE, View, belief_loss
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
Step = Callable[..., Tensor]
"""As `Onward` is called."""
_WARM_UP_CALLS = 3


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


class Onward(nn.Module):
    """A control step of the memory, from tensors to tensors, as tracing takes it.

    Args:
        network: Whose memory it is.
    """

    def __init__(self, network: BeliefNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(
        self, memory: Tensor, set_point: Tensor, q: Tensor, *seen: tuple[Tensor, Tensor, Tensor]
    ) -> Tensor:
        """Go on to where the arm was sent, and take an observation in.

        Args:
            memory: (B, k) float64.
            set_point: Of the joints, (B, 7) float64 rad.
            q: Measured joint positions, (B, 7) rad.
            *seen: Of each camera what its eye saw, (B, 9), and where it is, as in `View`.

        Returns:
            (B, k) float64.
        """
        network = self._network
        sightings, views = {}, {}
        for name, (sighting, origin, rotation) in zip(network.shape.cameras, seen, strict=True):
            sightings[name] = sighting
            views[name] = View(origin, rotation, network.cell.tan[name])
        return network.remember(network.sent_on(memory, set_point), sightings, q, views)


def traced(network: BeliefNetwork, window: Window) -> Step:
    """`Onward` for as many windows as these, compiled: the same numbers in less time.

    Called operation by operation from Python, what takes the time of a control step is not the sums
    but getting to them. It goes by the network's weights as they are when it is called.

    Args:
        network: Whose memory it is.
        window: Any with as many windows.
    """
    example = (window.memory, *_observed(network, window)[0])
    with warnings.catch_warnings():
        # As in `hvs_suite.policies.belief.acting`: it holds for as many windows as these alone.
        warnings.simplefilter("ignore")
        step: Step = torch.jit.trace(  # type: ignore[no-untyped-call]
            Onward(network), example, check_trace=False
        )
        # TorchScript settles how it computes at its first calls. After them a training that was
        # killed goes on with the numbers to the last digit.
        for _ in range(_WARM_UP_CALLS):
            learned = [*network.belief.parameters()]
            torch.autograd.grad(step(*example).sum(), learned, allow_unused=True)
    return step


def remembered(network: BeliefNetwork, window: Window, step: Step | None = None) -> Tensor:
    """The memory at each step, its observation in it, (B, T, k) float64.

    Args:
        network: Whose memory it is.
        window: What is taken in.
        step: `traced`, for as many windows; None goes on without.
    """
    step = step or Onward(network)
    memory, memories = window.memory, []
    for seen in _observed(network, window):
        memory = step(memory, *seen)
        memories.append(memory)
    return torch.stack(memories, dim=1)


def _observed(network: BeliefNetwork, window: Window) -> list[tuple[Any, ...]]:
    """What `Onward` takes in at each step."""
    n, length = window.counts.shape
    q = window.state[..., :N_JOINTS]
    views = network.views(geometry.flange_motion(q.reshape(-1, N_JOINTS).double()))
    set_point = window.truth.set_point.double()
    by_camera = [
        (
            window.sightings[name],
            view.origin.reshape(n, length, 3),
            view.rotation.reshape(n, length, 3, 3),
        )
        for name, view in views.items()
    ]
    return [
        (set_point[:, t], q[:, t], *(tuple(part[:, t] for part in each) for each in by_camera))
        for t in range(length)
    ]


def window_lesson(
    network: BeliefNetwork, window: Window, step: Step | None = None
) -> tuple[Tensor, Parts]:
    """Loss of belief and head over windows.

    Args:
        network: What learns; no gradient reaches its eyes.
        window: What it learns from.
        step: As in `remembered`.

    Returns:
        Scalar, and its parts.
    """
    counts = window.counts
    memory, state = remembered(network, window, step)[counts], window.state[counts]
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
