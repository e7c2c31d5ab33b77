"""Plays a checkpoint folder, ours or any other LeRobot policy's, in an environment.

A checkpoint of type `hvs` whose processors are the standard identity ones is played
by its network alone: LeRobot's policies take ten seconds and a gigabyte to import, in every worker.
Tests hold that both ways give the same action. Anything else goes through LeRobot.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.datasets.features import IMAGES, OBSERVATION, STATE
from hvs_suite.errors import PolicyError, first_line
from hvs_suite.policies.belief.acting import CompiledBelief
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.settings import Settings
from hvs_suite.policies.checkpoints.files import (
    CONFIG,
    POSTPROCESSOR,
    PREPROCESSOR,
    WEIGHTS,
    check_sizes,
    check_weights,
    read_config,
    read_settings,
    read_steps,
)
from hvs_suite.policies.trained_for import OURS, check_trained_for
from hvs_suite.rollout import Observation, one_torch_thread
from hvs_suite.tasks.shared.spec import Spec

Action = npt.NDArray[np.float32]
Batch = dict[str, Any]
"""Tensors under LeRobot's names, and the task as a sentence."""
Decide = Callable[[Batch], Tensor]

TASK = "task"
TYPE = "hvs"
"""Of our own policy, as LeRobot names it."""

# Where the network's own keys live in a checkpoint of the LeRobot policy around it.
NETWORK_PREFIX = "network."
STANDARD_STEPS = {
    PREPROCESSOR: (
        "rename_observations_processor",
        "to_batch_processor",
        "device_processor",
        "normalizer_processor",
    ),
    POSTPROCESSOR: ("unnormalizer_processor", "device_processor"),
}


class Stage(Protocol):
    """What a checkpoint needs of an environment."""

    @property
    def spec(self) -> Spec:
        """Parameters of the task."""


@dataclasses.dataclass(frozen=True)
class CheckpointFactory:
    """Makes policies from a checkpoint folder; travels to workers as its path.

    Attributes:
        folder: The checkpoint.
    """

    folder: str

    def __call__(self, env: Stage) -> "CheckpointPolicy":
        """Load the checkpoint for an environment.

        Raises:
            PolicyError: It cannot be loaded, or does not fit the environment.
        """
        return CheckpointPolicy(Path(self.folder), env.spec)


class CheckpointPolicy:
    """A LeRobot policy behind the suite's policy interface.

    Args:
        folder: The checkpoint.
        spec: Task to be played.

    Raises:
        PolicyError: The checkpoint cannot be loaded, or does not fit the task.
    """

    def __init__(self, folder: Path, spec: Spec) -> None:
        config = read_config(folder)
        check_fit(config, folder, spec)
        self._inputs = tuple(config["input_features"])
        with one_torch_thread():
            if config["type"] == TYPE and _processors_are_standard(folder):
                self._decide, self._forget = _network(folder, config)
            else:
                self._decide, self._forget = _lerobot(folder)
        self._sentence = spec.instruction()

    def instruct(self, sentence: str) -> None:
        """Take in the task of the coming episode as a sentence."""
        self._sentence = sentence

    def reset(self) -> None:
        """Forget the last episode."""
        self._forget()

    def select_action(self, observation: Observation) -> Action:
        """Decide on an unbatched observation of the environment.

        Args:
            observation: ``eih`` and ``eth`` (H, W, C) uint8, ``joint_positions`` (7,) rad and
                ``joint_velocities`` (7,) rad/s, as far as the policy reads them.

        Returns:
            (7,) float32.
        """
        with one_torch_thread(), torch.inference_mode():
            action = self._decide({**as_batch(observation, self._inputs), TASK: self._sentence})
        return np.array(action.reshape(-1).cpu().numpy(), np.float32)


def as_batch(observation: Observation, keys: Iterable[str]) -> dict[str, Tensor]:
    """An observation of the environment under LeRobot's names and in its ranges.

    Args:
        observation: As in `CheckpointPolicy.select_action`.
        keys: What is read of it: ``observation.images.<camera>``, ``observation.state`` and
            ``observation.<name>``, what else a family shows.

    Returns:
        Images (C, H, W) in [0, 1] and the state (14,) or (7,), float32, no batch dimension.
    """
    batch: dict[str, Tensor] = {}
    for key in keys:
        if key.startswith(IMAGES):
            image = torch.from_numpy(observation[key.removeprefix(IMAGES)])
            batch[key] = image.permute(2, 0, 1).to(torch.float32) / 255.0
        elif key == STATE:
            parts = ["joint_positions", "joint_velocities"]
            joints = [observation[name] for name in parts if name in observation]
            batch[key] = torch.from_numpy(np.concatenate(joints).astype(np.float32))
        else:
            vector = observation[key.removeprefix(OBSERVATION)]
            batch[key] = torch.from_numpy(vector.astype(np.float32))
    return batch


class Inputs(NamedTuple):
    """An observation as `hvs_suite.policies.belief.acting.act` takes it, a batch of one."""

    images: dict[str, Tensor]
    state: Tensor
    goal: Tensor | None
    felt: Tensor | None


def network_inputs(
    network: BeliefNetwork, config: Mapping[str, Any], observation: Observation
) -> Inputs:
    """An observation as a `BeliefNetwork` takes it.

    Args:
        network: Its shape says what it looks at.
        config: Of its checkpoint, which says what else it reads.
        observation: As in `CheckpointPolicy.select_action`.
    """
    return _inputs(network, config, as_batch(observation, config["input_features"]))


def _inputs(network: BeliefNetwork, config: Mapping[str, Any], batch: Batch) -> Inputs:
    goal, wrench = config["goal_key"], config["wrench_key"]
    return Inputs(
        {name: batch[IMAGES + name][None] for name in network.shape.cameras},
        batch[STATE][None],
        None if goal is None else batch[goal][None],
        None if wrench is None else batch[wrench][None],
    )


def check_fit(config: Mapping[str, Any], folder: Path, spec: Spec) -> None:
    """Check that a task shows what a checkpoint reads, in the same size, and takes its actions.

    One of ours also has to be trained for such tasks; see `check_trained_for`.

    Args:
        config: Of the checkpoint.
        folder: The checkpoint, for the message.
        spec: The task.

    Raises:
        PolicyError: It does not fit.
    """
    if config.get("type") in OURS:
        check_trained_for(config, folder, spec)
    shown = spec.observed
    mismatch = f"{folder} does not fit {spec.name}: "
    if spec.action_mode != "joint_position" or spec.normalise_observation:
        raise PolicyError(
            mismatch + "checkpoints read raw observations and command joint positions"
        )
    for key, feature in config["input_features"].items():
        shape = tuple(feature["shape"])
        name = key.removeprefix(IMAGES)
        if key == STATE:
            available = N_JOINTS * sum(
                part in shown for part in ("joint_positions", "joint_velocities")
            )
            if "joint_positions" not in shown or shape != (available,):
                raise PolicyError(
                    mismatch + f"it reads {shape[0]} joint numbers, the task shows {available}"
                )
        elif (vector := key.removeprefix(OBSERVATION)) in spec.further_observations:
            size = len(spec.further_observations[vector].dimensions)
            if vector not in shown or shape != (size,):
                raise PolicyError(mismatch + f"it reads {key}, which the task shows otherwise")
        elif name == key or name not in shown or name not in ("eih", "eth"):
            raise PolicyError(mismatch + f"it reads {key}, which the task does not show")
        else:
            side = getattr(spec, f"{name}_resolution")
            expected = (getattr(spec, f"{name}_channels"), side, side)
            if shape != expected:
                raise PolicyError(
                    mismatch + f"it reads {key} as {_size(shape)}, the task shows {_size(expected)}"
                )


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in (*shape[1:], shape[0]))


def _processors_are_standard(folder: Path) -> bool:
    """Whether the processors do nothing but add a batch dimension."""
    for name, expected in STANDARD_STEPS.items():
        steps = read_steps(folder, name)
        if tuple(step.registry_name for step in steps) != expected:
            return False
        for step in steps:
            modes = step.config.get("norm_map", {})
            if step.config.get("rename_map") or not isinstance(modes, dict):
                return False
            if any(mode != "IDENTITY" for mode in modes.values()):
                return False
    return True


def load_network(folder: Path) -> BeliefNetwork:
    """Load the network of an `hvs` checkpoint, without LeRobot.

    Args:
        folder: The checkpoint.

    Returns:
        The network, in evaluation mode.

    Raises:
        PolicyError: It is of another policy, or cannot be loaded.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    config = read_config(folder)
    if config["type"] != TYPE:
        raise PolicyError(f"{folder} holds a policy of type {config['type']}, not {TYPE}")
    settings = read_settings(Settings, folder)
    check_weights(folder, settings.network, NETWORK_PREFIX)
    try:
        network = settings.network()
        weights = load_file(folder / WEIGHTS)
        network.load_state_dict({k.removeprefix(NETWORK_PREFIX): v for k, v in weights.items()})
    except (SafetensorError, OSError, RuntimeError) as error:
        raise PolicyError(f"{folder} cannot be loaded: {first_line(error)}") from error
    return network.eval()


def weights_digest(folder: Path) -> str:
    """SHA-256 of a checkpoint's weights.

    Args:
        folder: The checkpoint.

    Raises:
        PolicyError: It is no checkpoint, see `read_config`.
    """
    read_config(folder)
    with (folder / WEIGHTS).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


Player = tuple[Decide, Callable[[], None]]
"""What decides, and what forgets the last episode."""


def _network(folder: Path, config: Mapping[str, Any]) -> Player:
    """Play the network of an `hvs` checkpoint by itself."""
    network, compiled = _compiled(folder, weights_digest(folder), (folder / CONFIG).read_bytes())
    memory: Tensor | None = None

    def decide(batch: Batch) -> Tensor:
        nonlocal memory
        inputs = _inputs(network, config, batch)
        action, memory = compiled(inputs.images, inputs.state, memory, inputs.goal, inputs.felt)
        return action

    def forget() -> None:
        nonlocal memory
        memory = None

    return decide, forget


# What TorchScript compiles holds 40 MB until the process ends; a study, which plays one checkpoint
# in dozens of cells, compiles it once.
@functools.lru_cache(maxsize=32)
def _compiled(folder: Path, weights: str, config: bytes) -> tuple[BeliefNetwork, CompiledBelief]:
    """A network and its compiled form, neither of which remembers an episode.

    Args:
        folder: The checkpoint.
        weights: Their digest: with other content, the same folder is another checkpoint.
        config: Content of its ``config.json``, likewise.
    """
    network = load_network(folder)
    return network, CompiledBelief(network)


def _lerobot(folder: Path) -> Player:
    """Load any LeRobot policy with its processors, on the CPU."""
    try:
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    except ImportError as error:
        raise PolicyError("LeRobot is missing; install hvs-suite[learn]") from error
    import hvs_suite.policies.hvs  # noqa: F401 - registers the type

    try:
        config = PreTrainedConfig.from_pretrained(folder, local_files_only=True)
        config.device = "cpu"
        if hasattr(config, "pretrained_backbone_weights"):
            # Where training began; fetched, although the checkpoint's own weights replace them.
            config.pretrained_backbone_weights = None
        check_sizes(folder, vars(config))
        policy_class = get_policy_class(config.type)
        check_weights(folder, lambda: policy_class(config))
        policy = policy_class.from_pretrained(folder, config=config, local_files_only=True)
        before, after = make_pre_post_processors(
            config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": "cpu"}},
        )
    except PolicyError:
        raise
    except Exception as error:  # LeRobot and what it loads raise anything
        raise PolicyError(f"LeRobot cannot load {folder}: {first_line(error)}") from error

    def decide(batch: Batch) -> Tensor:
        action: Tensor = after(policy.select_action(before(batch)))
        return action

    return decide, policy.reset
