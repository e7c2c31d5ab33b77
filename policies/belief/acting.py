"""One control step of the network: look, remember, decide; as it is, and compiled.

Called operation by operation from Python, what takes the time of a decision is not the sums but
getting to them. Traced once and frozen, it is one call.
"""

import warnings
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork

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
    action = network.to_action(network.decide(memory, sightings, state, felt), memory)
    return action, network.commanded(memory, action)


class CompiledBelief:
    """Plays a `BeliefNetwork`, one observation at a time.

    Args:
        network: In evaluation mode; later changes of its weights are not noticed.
    """

    def __init__(self, network: BeliefNetwork) -> None:
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
        with torch.no_grad(), warnings.catch_warnings():
            # Tracing holds for batches of one alone, which is all it is made for; and newer Python
            # will want another compiler, which needs a C++ one installed.
            warnings.simplefilter("ignore")
            traced = torch.jit.trace(  # type: ignore[no-untyped-call]
                _Acts(network).eval(), example, check_trace=False
            )
            self._frozen = torch.jit.freeze(traced)
            for _ in range(_WARM_UP_CALLS):
                self._frozen(*example)

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
        action, memory = self._frozen(
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
