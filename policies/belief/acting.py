"""One control step of the network: look, remember, decide; as it is, and compiled.

Called operation by operation from Python, what takes the time of a decision is not the sums but
getting to them. Traced once and frozen, it is one call.
"""

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.residual import N_LENGTHS

# TorchScript looks at what it runs before it settles how.
_WARM_UP_CALLS = 3


def act(
    network: BeliefNetwork,
    images: Mapping[str, Tensor],
    state: Tensor,
    memory: Tensor,
    goal: Tensor | None = None,
    felt: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Decide on an observation.

    Args:
        network: The network.
        images: Camera name to (B, C, H, W), float in [0, 1] or uint8.
        state: Measured joint positions and velocities, (B, 14) rad and rad/s.
        memory: What the last call returned, or `BeliefNetwork.start`, (B, k) float64.
        goal: Which target is meant, one-hot (B, n); None for a policy that is not told.
        felt: Force and torque, (B, 6) N and Nm; None without.

    Returns:
        Joint position targets in units of the joint range, (B, 7) in [-1, 1], and the memory for
        the next call.
    """
    sightings = network.look(images, goal)
    memory = network.remember(memory, sightings, state[:, :N_JOINTS])
    if network.residual is not None:
        memory, read = network.feel(memory, sightings, state, felt)
        memory = network.move_goal(memory, network.residual(read))
    action = network.to_action(network.decide(memory, sightings, state, felt).out, memory)
    return action, network.commanded(memory, action)


class CompiledBelief:
    """Plays a `BeliefNetwork`, one observation at a time.

    Args:
        network: In evaluation mode.
        is_frozen: Whether its weights stay as they are; otherwise later changes are noticed.
    """

    def __init__(self, network: BeliefNetwork, *, is_frozen: bool = True) -> None:
        shape = network.shape
        self._cameras = tuple(shape.cameras)
        self._start = network.start(1)
        self._nothing = torch.zeros(1, 0)
        example = (
            tuple(
                torch.zeros(1, channels, side, side) for channels, side in shape.cameras.values()
            ),
            torch.zeros(1, 2 * N_JOINTS),
            self._start,
            torch.zeros(1, shape.n_goals),
            torch.zeros(1, shape.n_felt),
        )
        self._compiled = _compiled(_Acts(network), example, is_frozen=is_frozen)

    def __call__(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        memory: Tensor | None,
        goal: Tensor | None = None,
        felt: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Decide as `act` does, on a batch of one.

        Args:
            images: As in `act`, float in [0, 1].
            state: As in `act`.
            memory: What the last call returned, or None at the start of an episode.
            goal: As in `act`.
            felt: As in `act`.

        Returns:
            As `act`.
        """
        action, memory = self._compiled(
            tuple(images[name] for name in self._cameras),
            state,
            self._start if memory is None else memory,
            self._nothing if goal is None else goal,
            self._nothing if felt is None else felt,
        )
        return action, memory


class _Acts(nn.Module):
    """`act` as tracing takes it: tensors in, tensors out, no branch."""

    def __init__(self, network: BeliefNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(
        self, images: tuple[Tensor, ...], state: Tensor, memory: Tensor, goal: Tensor, felt: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The action, and the next memory."""
        shape = self._network.shape
        return act(
            self._network,
            dict(zip(shape.cameras, images, strict=True)),
            state,
            memory,
            goal if shape.n_goals else None,
            felt if shape.n_felt else None,
        )


class CompiledParts:
    """Plays a network with a residual, whose place somebody else takes; one observation at a time.

    Args:
        network: In evaluation mode; later changes of its weights are not noticed.
    """

    def __init__(self, network: BeliefNetwork) -> None:
        assert network.residual is not None
        shape = network.shape
        self._cameras = tuple(shape.cameras)
        self._nothing = torch.zeros(1, 0)
        images = tuple(torch.zeros(1, c, side, side) for c, side in shape.cameras.values())
        state, memory = torch.zeros(1, 2 * N_JOINTS), network.start(1)
        goal, felt = torch.zeros(1, shape.n_goals), torch.zeros(1, shape.n_felt)
        sightings = tuple(torch.zeros(1, SIGHTING_SIZE) for _ in self._cameras)
        share = torch.zeros(1, N_LENGTHS)
        self._perceives = _compiled(_Perceives(network), (images, state, memory, goal, felt))
        self._responds = _compiled(_Responds(network), (memory, sightings, state, share, felt))

    def perceive(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        memory: Tensor,
        goal: Tensor | None,
        felt: Tensor | None,
    ) -> tuple[Tensor, tuple[Tensor, ...], Tensor]:
        """Take an observation in, all arguments as in `act`.

        Returns:
            The memory with it, the sightings, and what the residual reads.
        """
        return self._perceives(
            tuple(images[name] for name in self._cameras),
            state,
            memory,
            self._nothing if goal is None else goal,
            self._nothing if felt is None else felt,
        )

    def respond(
        self,
        memory: Tensor,
        sightings: tuple[Tensor, ...],
        state: Tensor,
        share: Tensor,
        felt: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Move the goal by shares (1, 3) of the largest step, and decide; what `act` returns."""
        return self._responds(
            memory, sightings, state, share, self._nothing if felt is None else felt
        )


class _Perceives(nn.Module):
    """The first half of `act`, as tracing takes it."""

    def __init__(self, network: BeliefNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(
        self, images: tuple[Tensor, ...], state: Tensor, memory: Tensor, goal: Tensor, felt: Tensor
    ) -> tuple[Tensor, tuple[Tensor, ...], Tensor]:
        """The memory, the sightings, and what the residual reads."""
        network, shape = self._network, self._network.shape
        seen = dict(zip(shape.cameras, images, strict=True))
        sightings = network.look(seen, goal if shape.n_goals else None)
        memory = network.remember(memory, sightings, state[:, :N_JOINTS])
        memory, read = network.feel(memory, sightings, state, felt if shape.n_felt else None)
        return memory, tuple(sightings.values()), read


class _Responds(nn.Module):
    """The second half of `act`, as tracing takes it."""

    def __init__(self, network: BeliefNetwork) -> None:
        super().__init__()
        self._network = network

    def forward(
        self,
        memory: Tensor,
        sightings: tuple[Tensor, ...],
        state: Tensor,
        share: Tensor,
        felt: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """The action, and the next memory."""
        network, shape = self._network, self._network.shape
        seen = dict(zip(shape.cameras, sightings, strict=True))
        memory = network.move_goal(memory, share)
        out = network.decide(memory, seen, state, felt if shape.n_felt else None).out
        action = network.to_action(out, memory)
        return action, network.commanded(memory, action)


def _compiled(module: nn.Module, example: tuple[Any, ...], *, is_frozen: bool = True) -> Any:
    """A module, traced, and frozen if it may be."""
    with torch.no_grad(), warnings.catch_warnings():
        # Tracing holds for batches of one alone, which is all it is made for; and newer Python
        # will want another compiler, which needs a C++ one installed.
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(  # type: ignore[no-untyped-call]
            module.eval(), example, check_trace=False
        )
        if is_frozen:
            traced = torch.jit.freeze(traced)
        for _ in range(_WARM_UP_CALLS):
            traced(*example)
    return traced
