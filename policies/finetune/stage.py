"""The environment of fine-tuning: the base policy plays, and the action is what to add to it.

Images never leave the worker. What goes into the replay memory is what the base's eyes and geometry
made of them, a hundred numbers, so that an update costs as much as RL on states. Critics also see
what only the simulator knows; the actor, which has to do without in the end, does not.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor

from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, after_commands
from hvs_suite.policies.checkpoints.loading import network_inputs
from hvs_suite.policies.finetune.folding import load_base
from hvs_suite.policies.finetune.settings import Settings
from hvs_suite.policies.network.compiled import CompiledFeatures
from hvs_suite.policies.network.network import N_JOINTS
from hvs_suite.policies.rl.curriculum import Curriculum
from hvs_suite.policies.rl.journal import OUTCOMES, Journal
from hvs_suite.rollout import one_torch_thread

FEATURES = "features"
"""Key of what the actor reads: `Decision.features` of the base."""
PRIVILEGED = "privileged"
"""Key of what only the critics read, see `privileged_state`."""
PRIVILEGED_SIZE = 46
JOINTS, GOAL, NORMAL = slice(0, N_JOINTS), slice(26, 29), slice(29, 32)
"""Where true joint positions, and the goal's place and normal stand in it."""
COMING, SENT = slice(32, 39), slice(39, 46)
"""Where joint positions and set point stand in it, as they will be when the action acts."""

Observation = dict[str, npt.NDArray[np.float32]]


def privileged_state(environment: Any, error_scale: float) -> npt.NDArray[np.float32]:
    """What the critics see beyond the features.

    Args:
        environment: A `hvs_suite.load`ed environment.
        error_scale: Of the network (m); errors are read as asinh(x / this).

    Returns:
        (46,): true joint positions and velocities in units of their limits, the way left to the
        goal in the base frame, the rotation vector from flange axis to inward normal, what is left
        of the time, steps held, both cameras' targets, the goal's place (m) and normal, and joint
        positions and set point that all actions so far lead to, in units of the joints' limits.
    """
    truth, info, spec = environment.privileged(), environment.info, environment.spec
    rotation, position = kinematics().flange_pose(truth["joint_positions"])
    way = truth["goal_position"] - position
    turn = np.cross(rotation[:, 2], -truth["goal_normal"])
    left = 1.0 - environment.control_steps / spec.time_limit_steps
    coming, _, sent = after_commands(
        environment.joint_positions,
        environment.joint_velocities,
        environment.setpoint,
        environment.pending_setpoints,
        spec.control_period_s,
    )
    return np.concatenate(
        [
            truth["joint_positions"] / JOINT_RANGE_RAD,
            environment.joint_velocities / JOINT_SPEED_RAD_S,
            np.arcsinh(way / error_scale),
            np.arcsinh(turn / error_scale),
            [left, info["n_inside"] / spec.hold_steps],
            truth["target_eih"][[2, 3]],
            truth["target_eth"][[2, 3]],
            truth["goal_position"],
            truth["goal_normal"],
            coming / JOINT_RANGE_RAD,
            sent / JOINT_RANGE_RAD,
        ]
    ).astype(np.float32)


class ResidualStage(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Shows the base's features, and adds a residual to what the base says.

    Observations are a ``Dict`` of ``features`` and ``privileged``, both vectors of float32. An
    action is seven numbers in [-1, 1], shares of the bound: ``out = base + bound * action``, inside
    the logarithmic scale that joint steps are learned in. The action zero plays the base policy.

    The reward is the task's, and a potential beside it that changes no best policy (Ng, Harada and
    Russell, 1999): gamma * phi(s') - phi(s), with phi(s) = -weight * sum of asinh(error /
    tolerance) over the errors that the task bounds, and 0 at the end of an episode.

    Args:
        env: An `hvs_suite.gym.TaskEnv`.
        checkpoint: The base policy.
        bound: The most that an action adds.
        shaping: Weight of the potential.
        gamma: Discount.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        checkpoint: Path,
        bound: float,
        shaping: float,
        gamma: float,
    ) -> None:
        super().__init__(env)
        with one_torch_thread():
            self._network = load_base(checkpoint)
            self._features = CompiledFeatures(self._network)
        self._bound = bound
        self._shaping = shaping
        self._gamma = gamma
        self._environment: Any = env.unwrapped.environment  # type: ignore[attr-defined]
        self._bounds = self._environment.spec.step_bounds
        self._memory: torch.Tensor | None = None
        self._out: torch.Tensor | None = None
        self._state: torch.Tensor | None = None
        self._potential = 0.0
        sizes = {FEATURES: self._network.n_features, PRIVILEGED: PRIVILEGED_SIZE}
        self.observation_space = spaces.Dict(
            {k: spaces.Box(-np.inf, np.inf, (size,), np.float32) for k, size in sizes.items()}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (N_JOINTS,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode, options as the environment takes them."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._memory = None
        self._potential = self._phi(info)
        return self._look(observation), info

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one control step with the base's action and what is added to it."""
        assert self._out is not None
        assert self._memory is not None
        assert self._state is not None
        added = self._bound * torch.from_numpy(np.clip(action, -1.0, 1.0).astype(np.float32))
        with torch.inference_mode():
            origin = self._network.origin(self._state, self._memory)
            command = self._network.to_action(self._out + added, origin)
            self._memory = self._network.commanded(self._memory, command)
        observation, reward, terminated, truncated, info = self.env.step(command[0].numpy())
        before, self._potential = self._potential, self._phi(info)
        after = 0.0 if terminated or truncated else self._potential
        reward = float(reward) + self._gamma * after - before
        return self._look(observation), reward, terminated, truncated, info

    def _phi(self, info: Mapping[str, Any]) -> float:
        errors = [info["errors"][name] / bound for name, bound in self._bounds.items()]
        return -self._shaping * float(np.arcsinh(errors).sum())

    def _look(self, observation: Mapping[str, npt.NDArray[Any]]) -> Observation:
        with one_torch_thread(), torch.inference_mode():
            images, self._state = network_inputs(self._network, observation)
            assert self._state is not None
            features, self._memory = self._features(images, self._state, self._memory)
            self._out = features[:, -N_JOINTS:]
        return {
            FEATURES: features[0].numpy().copy(),
            PRIVILEGED: privileged_state(self._environment, self._network.shape.error_scale),
        }


@dataclasses.dataclass(frozen=True)
class MakeStage:
    """Makes one of a run's environments; travels to its worker.

    Attributes:
        task: Named task.
        options: Task options that differ from it.
        levels: Further options, of each level of the curriculum.
        split: Stream of scenes.
        folder: Checkpoint that plays.
        settings: Of the run.
        seed: Of the run.
        part: Which of the environments it is.
    """

    task: str
    options: Mapping[str, Any]
    levels: list[dict[str, Any]]
    split: str
    folder: str
    settings: Settings
    seed: int
    part: int = 0

    def __call__(self) -> gymnasium.Env[Any, Any]:
        """Make it."""
        settings = self.settings
        env = Curriculum(self.task, self.levels, split=self.split, **self.options)
        # The monitor inside: it sees the task's own rewards.
        stage = ResidualStage(
            Monitor(env, info_keywords=OUTCOMES),
            Path(self.folder),
            settings.bound,
            settings.shaping,
            settings.gamma,
        )
        return Journal(stage, self.seed, self.part, settings.environments, settings.lost_share)
