"""The environment's configuration, registered with LeRobot under the name ``hvs``."""

import dataclasses
import functools
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE, OBS_STR

from hvs_suite.errors import OptionError
from hvs_suite.gym import make_pixels_agent_pos
from hvs_suite.registry import find
from hvs_suite.tasks.shared.spec import Spec

_STATE_NAMES = ("joint_positions", "joint_velocities")
_CAMERA_NAMES = ("eih", "eth")
_JOINTS = 7


@EnvConfig.register_subclass("hvs")
@dataclasses.dataclass
class HvsEnvConfig(EnvConfig):
    """A named task of the suite for LeRobot's tools.

    Seeds are scenario indices (modulo 1,000 on ``test``): ``lerobot-eval``, which counts its seeds
    up from 1000, scores scenarios 0, 1, 2, ... of the test split.

    Attributes:
        task: Registered name, such as ``align-thesis``.
        split: Stream of scenarios.
        fps: Control steps a second; follows from the task.
        episode_length: Time limit in control steps; None keeps the task's own.
        options: Options of the task, for studies.
        features: What the environment observes and takes; follows from the task.
        features_map: Their names for the policy: the same ones.
    """

    task: str | None = "align-easy"
    split: str = "test"
    fps: int = 10
    episode_length: int | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    features: dict[str, PolicyFeature] = dataclasses.field(default_factory=dict)
    features_map: dict[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        spec = self.spec
        self.fps = spec.fps
        self.features = _features(spec)
        self.features_map = {name: name for name in self.features}

    @property
    def spec(self) -> Spec:
        """The task's parameters, options applied.

        Raises:
            UnknownTaskError: There is no such task.
            OptionError: An option does not exist or its value makes no sense.
        """
        options = dict(self.options)
        if self.episode_length is not None:
            options["time_limit_steps"] = self.episode_length
        return find(str(self.task)).with_options(options)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keywords of the environment's constructor."""
        kwargs: dict[str, Any] = {**self.options, "split": self.split, "render_mode": "rgb_array"}
        if self.episode_length is not None:
            kwargs["time_limit_steps"] = self.episode_length
        return kwargs

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]]]:
        """Makes the vector environment.

        Args:
            n_envs: Environments in it.
            use_async_envs: A process each, where there are several.

        Returns:
            ``{"hvs": {0: vector environment}}``.
        """
        make = functools.partial(make_pixels_agent_pos, str(self.task), **self.gym_kwargs)
        makers = [make] * n_envs
        vector: gymnasium.vector.VectorEnv[Any, Any, Any]
        if use_async_envs and n_envs > 1:
            vector = AsyncVectorEnv(
                makers, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP
            )
        else:
            vector = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vector}}


def _features(spec: Spec) -> dict[str, PolicyFeature]:
    """Features by their LeRobot names; image shapes are (H, W, C), as LeRobot asks of environments.

    Raises:
        OptionError: The task observes what LeRobot's policies cannot take.
    """
    names = spec.observed
    further = spec.further_observations
    known = (*_CAMERA_NAMES, *_STATE_NAMES, *further)
    foreign = [name for name in names if name not in known]
    channels = {"eih": spec.eih_channels, "eth": spec.eth_channels}
    grey = [name for name in names if channels.get(name, 3) != 3]
    if foreign or grey or spec.normalise_observation:
        raise OptionError(
            "LeRobot takes uint8 RGB images and joint values: leave out "
            f"{', '.join(foreign + grey) or 'normalise_observation'}."
        )
    sides = {"eih": spec.eih_resolution, "eth": spec.eth_resolution}
    features = {
        f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, (sides[name], sides[name], 3))
        for name in names
        if name in _CAMERA_NAMES
    }
    joints = _JOINTS * sum(name in _STATE_NAMES for name in names)
    if joints:
        features[OBS_STATE] = PolicyFeature(FeatureType.STATE, (joints,))
    for name in names:
        if name in further:
            shape = (len(further[name].dimensions),)
            features[f"{OBS_STR}.{name}"] = PolicyFeature(FeatureType.STATE, shape)
    size = 6 if spec.action_mode == "flange_twist" else _JOINTS
    features[ACTION] = PolicyFeature(FeatureType.ACTION, (size,))
    return features
