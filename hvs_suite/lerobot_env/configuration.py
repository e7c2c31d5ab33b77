"""The environments' configuration, registered with LeRobot under the name ``hvs``."""

import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig, parser
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE, OBS_STR

from hvs_suite.errors import OptionError, PolicyError
from hvs_suite.gym import make_pixels_agent_pos
from hvs_suite.registry import TASKS, find
from hvs_suite.tasks.shared.spec import Spec

_STATE_NAMES = ("joint_positions", "joint_velocities")
_CAMERA_NAMES = ("eih", "eth")
_JOINTS = 7


@EnvConfig.register_subclass("hvs")
@dataclasses.dataclass
class HvsEnvConfig(EnvConfig):
    """Named tasks of the suite for LeRobot's tools.

    Seeds are scenario indices (modulo 1,000 on ``test``): ``lerobot-eval``, which counts its seeds
    up from 1000, scores scenarios 0, 1, 2, ... of the test split.

    Attributes:
        task: Registered name, such as ``align-thesis``, a family's name for all of its tasks, or
            several of either with commas between them; all of them show the same.
        split: Stream of scenarios.
        fps: Control steps a second; follows from the task.
        episode_length: Time limit in control steps; None keeps the task's own.
        options: Options of the tasks, for studies.
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
        first, *others = self.specs
        self.fps = first.fps
        self.features = _features(first)
        self.features_map = {name: name for name in self.features}
        for spec in others:
            if spec.fps != self.fps or _features(spec) != self.features:
                raise OptionError(
                    f"{spec.name} and {first.name} show or take different things; evaluate them "
                    "one by one, or make them alike with --env.options"
                )

    @property
    def specs(self) -> tuple[Spec, ...]:
        """Parameters of each task, options applied.

        Raises:
            UnknownTaskError: There is no such task.
            OptionError: An option does not exist or its value makes no sense.
        """
        names = [
            name
            for word in str(self.task).split(",")
            for name in [n for n, spec in TASKS.items() if spec.family == word] or [word]
        ]
        return tuple(find(name).with_options(self._changed) for name in dict.fromkeys(names))

    @property
    def _changed(self) -> dict[str, Any]:
        """The options, the time limit among them."""
        if self.episode_length is None:
            return self.options
        return {**self.options, "time_limit_steps": self.episode_length}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keywords of the environment's constructor."""
        return {**self._changed, "split": self.split, "render_mode": "rgb_array"}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]]]:
        """Makes a vector environment a task.

        Args:
            n_envs: Environments in each.
            use_async_envs: A process each, where there are several.

        Returns:
            ``{task: {0: vector environment}}``, so that ``eval_info.json`` names the tasks.

        Raises:
            PolicyError: The command line names a policy that reads or gives other sizes.
        """
        _check_policy(env_to_policy_features(self), parser.get_path_arg("policy"), str(self.task))
        kind: Any = SyncVectorEnv
        if use_async_envs and n_envs > 1:
            kind = functools.partial(AsyncVectorEnv, context="forkserver")
        return {
            spec.name: {
                0: kind(
                    [functools.partial(make_pixels_agent_pos, spec.name, **self.gym_kwargs)]
                    * n_envs,
                    autoreset_mode=AutoresetMode.SAME_STEP,
                )
            }
            for spec in self.specs
        }


def _check_policy(shown: Mapping[str, PolicyFeature], policy: str | None, task: str) -> None:
    """Check that the policy that LeRobot is about to play fits the task's observations and actions.

    LeRobot compares names alone: pictures of another size would be played without a word.

    Args:
        shown: The task's features, as policies have them.
        policy: Folder or Hub id; None where none was named.
        task: For the message.

    Raises:
        PolicyError: A feature of the same name has another shape.
    """
    if policy is None:
        return
    config = PreTrainedConfig.from_pretrained(policy)
    for name, known in {**config.input_features, **config.output_features}.items():
        if name in shown and tuple(known.shape) != tuple(shown[name].shape):
            options = ""
            if known.type is FeatureType.VISUAL:
                camera, side = name.removeprefix(f"{OBS_IMAGES}."), known.shape[-1]
                option = json.dumps({f"{camera}_resolution": side})
                options = f"; --env.options='{option}' would show it in that size"
            raise PolicyError(
                f"{policy} has {name} as {_size(known)}, and {task} as {_size(shown[name])}"
                f"{options}"
            )


def _size(feature: PolicyFeature) -> str:
    return " x ".join(map(str, feature.shape))


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
