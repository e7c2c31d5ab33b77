"""Plays an actor that SAC trained, while it is being trained and from the folder it leaves.

A folder holds ``config.json`` (``"type": "hvs_sac"``), ``model.safetensors`` (the actor alone) and
``training/``. Nothing in it is a pickle.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces

from hvs_suite.errors import PolicyError
from hvs_suite.files import replacing
from hvs_suite.policies.trained_for import check_trained_for, trained_for
from hvs_suite.rollout import Observation, one_torch_thread
from hvs_suite.tasks.shared.spec import Spec, observation_names

if TYPE_CHECKING:
    from stable_baselines3.sac.policies import Actor

TYPE = "hvs_sac"
CONFIG = "config.json"
WEIGHTS = "model.safetensors"

Action = npt.NDArray[np.float32]


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


def is_sac(folder: Path) -> bool:
    """Whether a folder's ``config.json`` says that SAC was trained there."""
    try:
        config = json.loads((folder / CONFIG).read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(config, dict) and config.get("type") == TYPE


def write_config(
    folder: Path, spec: Spec, observation_space: spaces.Dict, hidden: tuple[int, ...]
) -> None:
    """Write what is needed to make the actor again.

    Args:
        folder: The checkpoint.
        spec: Task that is learnt, its options included.
        observation_space: Images (C, H, W) uint8 and joint inputs (7,) by name.
        hidden: Widths of the dense layers.
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
        "hidden": list(hidden),
    }
    with replacing(folder / CONFIG) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


def save_actor(folder: Path, actor: "Actor") -> None:
    """Write the actor's weights.

    Args:
        folder: The checkpoint.
        actor: On any device.
    """
    from safetensors.torch import save_file

    weights = {name: value.cpu().contiguous() for name, value in actor.state_dict().items()}
    with replacing(folder / WEIGHTS) as temporary:
        save_file(weights, temporary)


def read_config(folder: Path) -> dict[str, Any]:
    """Read a folder's ``config.json``.

    Args:
        folder: The checkpoint.

    Returns:
        The parsed file.

    Raises:
        PolicyError: There is none, or it is not of this kind.
    """
    if not is_sac(folder):
        raise PolicyError(f"{folder} holds no {CONFIG} of type {TYPE}")
    if not (folder / WEIGHTS).is_file():
        raise PolicyError(f"{folder} has no {WEIGHTS}; train it with hvs train-sac")
    config: dict[str, Any] = json.loads((folder / CONFIG).read_bytes())
    return config


def check_fit(config: Mapping[str, Any], folder: Path, spec: Spec) -> None:
    """Check that a task is what the actor was trained for, shows what it reads, takes its actions.

    Args:
        config: As `read_config` returns it.
        folder: The checkpoint, for the message.
        spec: The task.

    Raises:
        PolicyError: It does not fit, or the file is damaged.
    """
    check_trained_for(config, folder, spec)
    shown = observation_names(spec.observations)
    mismatch = f"{folder} does not fit {spec.name}: "
    try:
        if spec.normalise_observation or spec.action_mode != config["action_mode"]:
            raise PolicyError(
                mismatch + f"it reads raw observations and commands {config['action_mode']}"
            )
        for name, part in config["inputs"].items():
            if name not in shown:
                raise PolicyError(mismatch + f"it reads {name}, which the task does not show")
            if "shape" in part:
                side = getattr(spec, f"{name}_resolution")
                expected = [getattr(spec, f"{name}_channels"), side, side]
                if part["shape"] != expected:
                    raise PolicyError(
                        mismatch + f"it reads {name} as {part['shape']} (channels, rows, columns), "
                        f"the task shows {expected}"
                    )
    except (KeyError, TypeError, AttributeError) as error:
        raise PolicyError(f"{folder}/{CONFIG} is damaged: {error}") from error


def _load_actor(folder: Path, config: Mapping[str, Any]) -> "Actor":
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        from hvs_suite.policies.sac.network import make_actor
    except ImportError as error:
        raise PolicyError(
            f"playing {folder} needs Stable-Baselines3; install hvs-suite[learn]"
        ) from error
    try:
        space = spaces.Dict({name: _space(part) for name, part in config["inputs"].items()})
        n_actions = 6 if config["action_mode"] == "flange_twist" else 7
        action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float32)
        actor = make_actor(space, action_space, list(config["hidden"]))
        actor.load_state_dict(load_file(folder / WEIGHTS))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise PolicyError(f"{folder} cannot be loaded as a SAC actor: {reason}") from error
    actor.set_training_mode(False)
    return actor


def _space(part: Mapping[str, Any]) -> spaces.Box:
    if "shape" in part:
        return spaces.Box(0, 255, tuple(part["shape"]), np.uint8)
    high = np.array(part["high"], np.float32)
    return spaces.Box(-high, high, dtype=np.float32)
