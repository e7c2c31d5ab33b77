"""The thesis's network: a sub-network for each input, joined, then dense layers.

Stable-Baselines3 makes actor and critics around a features extractor; this is the extractor. Actor
and critics get one each, as in the thesis, unless they are to share it; SB3's twin critics share
theirs.
"""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor
from torch import Tensor, nn

from hvs_suite.policies.belief.eye import SIGHTING_SIZE, VISIBLE, Eye
from hvs_suite.policies.sac.settings import EyeKind, Settings

FILTERS = 32
KERNEL = 3
STRIDE = 2
JOINT_UNITS = 64
SHARED = "pictures"
"""Branch of both images where they share one."""


class ThesisExtractor(BaseFeaturesExtractor):
    """Two convolutions (32 filters, 3 x 3, stride 2) an image, two dense layers (64) a joint input.

    Images come as SB3 hands them over: (B, C, H, W) float32 in [0, 1]. Joint inputs, (B, 7) in rad
    and rad/s, are divided by their bounds, hence in [-1, 1], as in the thesis.

    Args:
        observation_space: Images (C, H, W) uint8 and joint inputs (7,) by name.
        eyes: As in `Settings`.
        trained: For ``pretrained``: the eye of each image, by name; they are copied.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        eyes: EyeKind = "apart",
        trained: Mapping[str, Eye] | None = None,
    ) -> None:
        branches: dict[str, nn.Module] = {}
        # Which branch reads an input; shared eyes are one branch.
        branch_of = {name: name for name in observation_space}
        bounds: dict[str, Tensor] = {}
        features_dim = 0
        for name, space in observation_space.items():
            shape = space.shape or ()
            if len(shape) == 3 and eyes == "pretrained":
                assert trained is not None
                branches[name] = nn.Sequential(_Looking(trained[name]), _dense(SIGHTING_SIZE))
                features_dim += JOINT_UNITS
            elif len(shape) == 3:
                branch_of[name] = SHARED if eyes == "shared" else name
                branches.setdefault(branch_of[name], _convolutions(shape[0]))
                features_dim += FILTERS * convolved(shape[1]) * convolved(shape[2])
            else:
                branches[name] = _dense(shape[0])
                bounds[name] = torch.from_numpy(np.asarray(space.high, np.float32))  # type: ignore[attr-defined]
                features_dim += JOINT_UNITS
        super().__init__(observation_space, features_dim)
        self.branches = nn.ModuleDict(branches)
        self._branch_of = branch_of
        self._scaled = tuple(bounds)
        for name, bound in bounds.items():
            self.register_buffer(f"bound_{name}", bound, persistent=False)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Features of a batch.

        Args:
            observations: (B, ...) by name.

        Returns:
            (B, features_dim).
        """
        parts = []
        for name, branch in self._branch_of.items():
            values = observations[name]
            if name in self._scaled:
                values = values / self.get_buffer(f"bound_{name}")
            parts.append(self.branches[branch](values))
        return torch.cat(parts, dim=1)


class _Looking(nn.Module):
    """What a trained eye says of an image; it learns nothing more."""

    def __init__(self, eye: Eye) -> None:
        super().__init__()
        self.eye = copy.deepcopy(eye).requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        with torch.no_grad():
            sighting: Tensor = self.eye(images)
        # Its only logit, which is as good as unbounded.
        sighting[:, VISIBLE] = torch.sigmoid(sighting[:, VISIBLE])
        return sighting


def convolved(side: int) -> int:
    """Side of the feature map that both convolutions leave of an image's side (px)."""
    for _ in range(2):
        side = (side - KERNEL) // STRIDE + 1
    return side


def make_actor(
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    hidden: list[int],
    eyes: EyeKind = "apart",
    eye_channels: int = 0,
) -> Actor:
    """SB3's own actor around the thesis's extractor, as `SAC` makes it; tanh keeps it in [-1, 1].

    Args:
        observation_space: Images (C, H, W) uint8 and joint inputs (7,) by name.
        action_space: Of the task.
        hidden: Widths of the dense layers.
        eyes: As in `Settings`.
        eye_channels: For ``pretrained``: channels of their features.
    """
    trained = {
        name: Eye(space.shape[0], space.shape[1], eye_channels)
        for name, space in observation_space.items()
        if eyes == "pretrained" and space.shape is not None and len(space.shape) == 3
    }
    extractor = ThesisExtractor(observation_space, eyes, trained)
    return Actor(observation_space, action_space, hidden, extractor, extractor.features_dim)


def policy_kwargs(settings: Settings, trained: Mapping[str, Eye]) -> dict[str, Any]:
    """What tells SB3's ``MultiInputPolicy`` to use this network; ReLU is its own default.

    Args:
        settings: Of SAC.
        trained: As in `ThesisExtractor`.
    """
    return {
        "features_extractor_class": ThesisExtractor,
        "features_extractor_kwargs": {"eyes": settings.eyes, "trained": trained},
        "share_features_extractor": settings.shared_trunk,
        "net_arch": list(settings.hidden),
    }


def _convolutions(channels: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(channels, FILTERS, KERNEL, STRIDE),
        nn.ReLU(),
        nn.Conv2d(FILTERS, FILTERS, KERNEL, STRIDE),
        nn.ReLU(),
        nn.Flatten(),
    )


def _dense(size: int) -> nn.Module:
    return nn.Sequential(
        nn.Linear(size, JOINT_UNITS), nn.ReLU(), nn.Linear(JOINT_UNITS, JOINT_UNITS), nn.ReLU()
    )
