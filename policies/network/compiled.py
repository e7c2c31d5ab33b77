"""The network compiled for playing: one observation at a time, on one core.

Called operation by operation from Python, a decision takes some two thousand calls, and most of the
time is the overhead of the calls, even more after the renderer has emptied the processor's caches.
Traced once and frozen, it is one call of some six hundred operations.
"""

import warnings
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from hvs_suite.policies.network import geometry
from hvs_suite.policies.network.network import Decision, HvsNetwork, memory_size

# TorchScript looks at what it runs before it settles how.
_WARM_UP_CALLS = 3

Says = Callable[[HvsNetwork, Decision, Tensor], tuple[Tensor, ...]]


class CompiledNetwork:
    """Plays an `HvsNetwork` that reads joints.

    Args:
        network: In evaluation mode; later changes of its weights are not noticed.
    """

    def __init__(self, network: HvsNetwork) -> None:
        self._network = network
        self._commands = _Compiled(network, _commands)

    def __call__(
        self, images: Mapping[str, Tensor], state: Tensor, memory: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Decide, as `HvsNetwork.forward` and `HvsNetwork.to_action` do together.

        Args:
            images: Camera name to (1, C, H, W), float in [0, 1].
            state: Measured joints, (1, 14) or (1, 7).
            memory: What the last call returned, or None at the start of an episode.

        Returns:
            Joint position targets in units of the joint range, (1, 7) in [-1, 1], and the memory
            (1, 4 n + 10) for the next call.
        """
        target, height, memory = self._commands(images, state, memory)
        action = self._network.within_bounds(target, height)
        return action, self._network.commanded(memory, action)


class CompiledFeatures:
    """Computes the features of an `HvsNetwork` that reads joints, for callers that decide by them.

    Args:
        network: In evaluation mode; later changes of its weights are not noticed.
    """

    def __init__(self, network: HvsNetwork) -> None:
        self._features = _Compiled(network, _features)

    def __call__(
        self, images: Mapping[str, Tensor], state: Tensor, memory: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Look, as `HvsNetwork.forward` does.

        Args:
            images: Camera name to (1, C, H, W), float in [0, 1].
            state: Measured joints, (1, 14) or (1, 7).
            memory: See `HvsNetwork.forward`.

        Returns:
            ``features`` and ``memory`` of the `Decision`.
        """
        features, memory = self._features(images, state, memory)
        return features, memory


class _Compiled:
    """A network that says something of its decision, traced and frozen for one observation."""

    def __init__(self, network: HvsNetwork, says: Says) -> None:
        self._cameras = tuple(network.shape.cameras)
        sizes = network.shape.cameras.values()
        images = tuple(torch.zeros(1, channels, side, side) for channels, side in sizes)
        state = torch.zeros(1, network.shape.state_dim)
        self._nothing = torch.zeros(1, memory_size(len(images)))
        with torch.no_grad(), warnings.catch_warnings():
            # Tracing holds for batches of one alone, which is all it is made for; and newer Python
            # will want another compiler, which needs a C++ one installed.
            warnings.simplefilter("ignore")
            traced = torch.jit.trace(  # type: ignore[no-untyped-call]
                _Decides(network, says).eval(), (images, state, self._nothing), check_trace=False
            )
            # Not optimize_for_inference: its convolutions take twice as long on larger images.
            self._frozen = torch.jit.freeze(traced)
            for _ in range(_WARM_UP_CALLS):
                self._frozen(images, state, self._nothing)

    def __call__(
        self, images: Mapping[str, Tensor], state: Tensor, memory: Tensor | None
    ) -> tuple[Tensor, ...]:
        seen = tuple(images[name] for name in self._cameras)
        result: tuple[Tensor, ...] = self._frozen(
            seen, state, self._nothing if memory is None else memory
        )
        return result


class _Decides(nn.Module):
    """A network as tracing takes it: tensors in, tensors out, no branch."""

    def __init__(self, network: HvsNetwork, says: Says) -> None:
        super().__init__()
        self._network = network
        self._says = says

    def forward(
        self, images: tuple[Tensor, ...], state: Tensor, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """The output, and the next memory."""
        named = dict(zip(self._network.shape.cameras, images, strict=True))
        decision = self._network(named, state, memory)
        return *self._says(self._network, decision, state), decision.memory


def _commands(network: HvsNetwork, decision: Decision, state: Tensor) -> tuple[Tensor, Tensor]:
    """Where to send the joints, and how high the flange is there."""
    assert decision.memory is not None
    target = network.to_target(decision.out, network.origin(state, decision.memory))
    return target, geometry.flange_motion(target).position[:, 2:]


def _features(network: HvsNetwork, decision: Decision, state: Tensor) -> tuple[Tensor]:
    """What a residual reads."""
    return (decision.features,)
