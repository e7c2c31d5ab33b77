"""Plays an actor that SAC trained, while it is being trained and from the folder it leaves.

A folder holds ``config.json`` (``"type": "hvs_sac"``), ``model.safetensors`` (the actor alone) and
``training/``. Nothing in it is a pickle.
"""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Protocol

import numpy as np
import numpy.typing as npt
import pydantic
import torch
from gymnasium import spaces

from hvs_suite.errors import PolicyError, first_line
from hvs_suite.files import replacing
from hvs_suite.policies.checkpoints.files import (
    CONFIG,
    WEIGHTS,
    Size,
    check_files,
    check_weights,
    read_settings,
    read_shapes,
)
from hvs_suite.policies.sac.settings import EyeKind, Settings
from hvs_suite.policies.trained_for import TrainedFor, check_trained_for, trained_for
from hvs_suite.rollout import Observation, one_torch_thread
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from stable_baselines3.sac.policies import Actor

TYPE = "hvs_sac"

Action = npt.NDArray[np.float32]


class Input(pydantic.BaseModel):
    """What the actor reads under one name: an image, or joints.

    Attributes:
        shape: Of an image, (channels, rows, columns).
        high: Bounds of a joint input; its values lie between these and their negatives.
    """

    model_config = pydantic.ConfigDict(extra="forbid")

    shape: Annotated[list[Size], pydantic.Field(min_length=3, max_length=3)] | None = None
    high: (
        Annotated[
            list[Annotated[float, pydantic.Field(gt=0.0, allow_inf_nan=False)]],
            pydantic.Field(min_length=1, max_length=64),
        ]
        | None
    ) = None

    @pydantic.model_validator(mode="after")
    def _is_one_of_both(self) -> "Input":
        if (self.shape is None) == (self.high is None):
            raise ValueError("an input has either a shape or bounds")
        return self


class Config(TrainedFor):
    """A folder's ``config.json``.

    Attributes:
        type: Of the policy.
        action_mode: What the actor commands.
        inputs: What it reads, by name.
        hidden: Widths of the dense layers.
        eyes: As in `Settings`.
        eye_channels: Channels of pretrained eyes.
    """

    type: Literal["hvs_sac"]
    action_mode: str
    inputs: Annotated[dict[str, Input], pydantic.Field(min_length=1, max_length=8)]
    hidden: Annotated[list[Size], pydantic.Field(max_length=16)]
    eyes: EyeKind = "apart"
    eye_channels: Size | None = None

    @pydantic.model_validator(mode="after")
    def _has_eyes(self) -> "Config":
        if (self.eyes == "pretrained") != (self.eye_channels is not None):
            raise ValueError("pretrained eyes have eye_channels, and others have none")
        channels = {part.shape[0] for part in self.inputs.values() if part.shape is not None}
        if self.eyes == "shared" and len(channels) > 1:
            raise ValueError("shared eyes read images with the same number of channels")
        return self


class Stage(Protocol):
    """What a checkpoint needs of an environment."""

    @property
    def spec(self) -> Spec:
        """Parameters of the task."""


class GreedyActor:
    """The most likely action of an actor, without exploration.

    Args:
        actor: SB3's, on any device.
    """

    def __init__(self, actor: "Actor") -> None:
        self._actor = actor
        space = actor.observation_space
        assert isinstance(space, spaces.Dict)
        self._inputs = {name: len(part.shape or ()) == 3 for name, part in space.items()}

    def reset(self) -> None:
        """Nothing to forget."""

    def select_action(self, observation: Observation) -> Action:
        """Decide on an unbatched observation of the environment.

        Args:
            observation: ``eih`` and ``eth`` (H, W, C) uint8, ``joint_positions`` (7,) rad and
                ``joint_velocities`` (7,) rad/s, as far as the actor reads them.

        Returns:
            (7,) float32 in [-1, 1].
        """
        batch: dict[str, torch.Tensor] = {}
        for name, is_image in self._inputs.items():
            value = np.asarray(observation[name])
            array = value.transpose(2, 0, 1) if is_image else value.astype(np.float32)
            batch[name] = torch.from_numpy(array[None].copy()).to(self._actor.device)
        with one_torch_thread(), torch.inference_mode():
            action = self._actor(batch, deterministic=True)
        return np.array(action[0].cpu().numpy(), np.float32)


@dataclasses.dataclass(frozen=True)
class SacFactory:
    """Makes policies from a folder; travels to workers as its path.

    Attributes:
        folder: The checkpoint.
    """

    folder: str

    def __call__(self, env: Stage) -> GreedyActor:
        """Load the actor for an environment.

        Raises:
            PolicyError: It cannot be loaded, or does not fit the environment.
        """
        folder = Path(self.folder)
        config = read_config(folder)
        check_fit(config, folder, env.spec)
        return GreedyActor(_load_actor(folder, config))


class _Typed(pydantic.BaseModel):
    type: str


def is_sac(folder: Path) -> bool:
    """Whether a folder's ``config.json`` says that SAC was trained there."""
    try:
        return read_settings(_Typed, folder).type == TYPE
    except PolicyError:
        return False


def write_config(
    folder: Path,
    spec: Spec,
    observation_space: spaces.Dict,
    settings: Settings,
    eye_channels: int | None,
) -> None:
    """Write what is needed to make the actor again.

    Args:
        folder: The checkpoint.
        spec: Task that is learnt, its options included.
        observation_space: Images (C, H, W) uint8 and joint inputs (7,) by name.
        settings: Of SAC.
        eye_channels: Channels of pretrained eyes; None without them.
    """
    inputs = {
        name: {"shape": list(space.shape or ())}
        if len(space.shape or ()) == 3
        else {"high": np.asarray(space.high).tolist()}  # type: ignore[attr-defined]
        for name, space in observation_space.items()
    }
    content = {
        "type": TYPE,
        "format": 1,
        "task": spec.name,
        **trained_for(spec).model_dump(),
        "action_mode": spec.action_mode,
        "inputs": inputs,
        "hidden": list(settings.hidden),
        "eyes": settings.eyes,
        "eye_channels": eye_channels,
    }
    with replacing(folder / CONFIG) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


def save_actor(folder: Path, actor: "Actor") -> None:
    """Write the actor's weights.

    Args:
        folder: The checkpoint.
        actor: On any device.
    """
    from safetensors.torch import save

    weights = {name: value.cpu().contiguous() for name, value in actor.state_dict().items()}
    with replacing(folder / WEIGHTS) as temporary:
        temporary.write_bytes(save(weights))


def read_config(folder: Path) -> Config:
    """Check a folder's files and read its ``config.json``; to be called before loading the actor.

    Args:
        folder: The checkpoint.

    Returns:
        The parsed file.

    Raises:
        PolicyError: There is none, it is not of this kind, or a file is damaged.
    """
    if not is_sac(folder):
        raise PolicyError(f"{folder} holds no {CONFIG} of type {TYPE}")
    if not (folder / WEIGHTS).is_file():
        raise PolicyError(f"{folder} has no {WEIGHTS}; train it with hvs train-sac")
    check_files(folder)
    config = read_settings(Config, folder)
    read_shapes(folder)
    return config


def check_fit(config: Config, folder: Path, spec: Spec) -> None:
    """Check that a task is what the actor was trained for, shows what it reads, takes its actions.

    Args:
        config: As `read_config` returns it.
        folder: The checkpoint, for the message.
        spec: The task.

    Raises:
        PolicyError: It does not fit.
    """
    check_trained_for(config.model_dump(), folder, spec)
    shown = spec.observed
    mismatch = f"{folder} does not fit {spec.name}: "
    if spec.normalise_observation or spec.action_mode != config.action_mode:
        raise PolicyError(mismatch + f"it reads raw observations and commands {config.action_mode}")
    for name, part in config.inputs.items():
        if name not in shown:
            raise PolicyError(mismatch + f"it reads {name}, which the task does not show")
        is_image = name in ("eih", "eth")
        if is_image != (part.shape is not None):
            raise PolicyError(mismatch + f"{name} is {'an' if is_image else 'no'} image")
        if is_image:
            side = getattr(spec, f"{name}_resolution")
            expected = [getattr(spec, f"{name}_channels"), side, side]
            if part.shape != expected:
                raise PolicyError(
                    mismatch + f"it reads {name} as {part.shape} (channels, rows, columns), "
                    f"the task shows {expected}"
                )


def _load_actor(folder: Path, config: Config) -> "Actor":
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        from hvs_suite.policies.sac.network import make_actor
    except ImportError as error:
        raise PolicyError(
            f"playing {folder} needs Stable-Baselines3; install hvs-suite[learn]"
        ) from error
    space = spaces.Dict({name: _space(part) for name, part in config.inputs.items()})
    n_actions = 6 if config.action_mode == "flange_twist" else 7
    action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float32)

    def make() -> "Actor":
        return make_actor(space, action_space, config.hidden, config.eyes, config.eye_channels or 0)

    check_weights(folder, make)
    try:
        actor = make()
        actor.load_state_dict(load_file(folder / WEIGHTS))
    except (SafetensorError, OSError, RuntimeError) as error:
        raise PolicyError(
            f"{folder} cannot be loaded as a SAC actor: {first_line(error)}"
        ) from error
    actor.set_training_mode(False)
    return actor


def _space(part: Input) -> spaces.Box:
    if part.shape is not None:
        return spaces.Box(0, 255, tuple(part.shape), np.uint8)
    high = np.array(part.high, np.float32)
    return spaces.Box(-high, high, dtype=np.float32)
