"""What the residual learns in: the imitated policy plays, and an action moves its goal.

Pictures never leave the process that plays: what goes into the replay memory is what the frozen
eyes, the belief and the arm's geometry made of them. As long as the tip is far from the goal no
action has an effect (`hvs_suite.policies.belief.residual`), so the policy flies there by itself,
and an episode begins with the first step in which one has. Where goals follow each other, each is
an episode of its own: a goal that is reached pays, and the way to the next is flown again.

Critics also see what only the simulator knows; the actor, which has to do without in the end, does
not.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from torch import Tensor

from hvs_suite.errors import PolicyError
from hvs_suite.policies.belief.acting import CompiledParts
from hvs_suite.policies.belief.network import FELT
from hvs_suite.policies.belief.residual import FINE_M, LONG_S, N_LENGTHS, SHIFT
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import network_inputs
from hvs_suite.policies.residual.folding import load_base, with_residual
from hvs_suite.policies.residual.settings import Settings
from hvs_suite.policies.rl.curriculum import Kind, Ladder, Level, levels_of
from hvs_suite.registry import find, load
from hvs_suite.rollout import one_torch_thread
from hvs_suite.tasks.shared.rewards import GOAL_REWARD

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

READ = "read"
"""Key of what the actor reads."""
PRIVILEGED = "privileged"
"""Key of what only the critics do, see `Stage`."""
SCENES_A_SEED = 10**9
"""Runs with different seeds learn from different scenes."""
MOST_FLIGHTS = 20
"""Scenes in a row in which the tip may come near no goal."""
ANOTHER_M = 0.1
"""A goal that was moved farther than this in a step is another one (m)."""
SOON_S = 0.2
"""The goal's way in this time is what critics know of its motion."""

Observation = dict[str, npt.NDArray[np.float32]]


@dataclasses.dataclass(frozen=True)
class Place:
    """How far a player has come: all that it takes to put it back there.

    Attributes:
        episode: Number of the scene.
        actions: Since it began, (3,) each, those of flights included.
        played: Control steps of all scenes.
        level: Of the curriculum.
        recent: How the last episodes ended on that level.
    """

    episode: int = 0
    actions: Sequence[Sequence[float]] = ()
    played: int = 0
    level: int = 0
    recent: Sequence[bool] = ()


class Stage(gymnasium.Env[Any, Any]):
    """Plays one scene of a split after the other.

    Observations are ``read``, what `Residual` reads, and ``privileged``: how far the tip is from
    the goal, how far the goal is from where it is believed to be after having been moved, and how
    it will move (3 each, in the goal's frame, logarithmic), what is left of the time, for how long
    there has been this goal and for how long it was held, and each error over its bound. An action
    is three shares in [-1, 1].

    The reward is the task's, or what reaching one of several goals pays, which is as much, less the
    cost of a step outside the tolerances, and a potential beside it that changes no best policy
    (Ng, Harada and Russell, 1999): gamma * phi(s') - phi(s), with phi(s) = -weight * sum of
    asinh(error / tolerance) over the errors that the task bounds, and 0 at the end of an episode.

    ``info`` counts scenes and all control steps, those of the flights included, and has the actions
    since the scene began; at the end of an episode it says how it ended.

    Args:
        make: What to play.
    """

    def __init__(self, make: "MakeStage") -> None:
        self._make = make
        folder = Path(make.folder)
        self._config = read_config(folder)
        self._levels: Sequence[Level] = [{}]
        if make.curriculum is not None:
            self._levels = levels_of(make.task, make.curriculum, make.options)
        self._ladder = Ladder(len(self._levels))
        self._ladder.load_state_dict(dataclasses.asdict(make.place))
        self._env = self._load()
        with one_torch_thread():
            settings = make.settings
            self._network = with_residual(load_base(folder), settings)
            self._parts = CompiledParts(self._network)
        assert self._network.residual is not None
        # Those of the task itself: what the critics read means the same on every level.
        self._bounds = make.bounds
        spec = find(make.task).with_options(make.options)
        self._step_bounds = spec.step_bounds
        self._counted = spec.counts_goals
        self._place = make.place
        self._scene, self._played = make.place.episode, make.place.played
        self._is_over, self._is_another, self._is_reached = True, False, False
        self._actions: list[list[float]] = []
        self._potential = self._return = 0.0
        self._age = 0
        self._memory: Tensor
        sizes = {
            READ: self._network.residual.n_inputs,
            PRIVILEGED: make.n_privileged,
        }
        self.observation_space = spaces.Dict(
            {k: spaces.Box(-np.inf, np.inf, (size,), np.float32) for k, size in sizes.items()}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (N_LENGTHS,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode, or at first go to where `MakeStage.place` says.

        Args:
            seed: Not used; the scenes are the run's own.
            options: Not used.
        """
        if self._place.actions:
            self._begin()
            for action in self._place.actions:
                self._play(np.array(action, np.float32))
            # These were counted already.
            self._played = self._place.played
        self._place = Place()
        self._fly()
        return self._observation(), self._counts()

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play a control step in which the goal is moved."""
        before = self._potential
        self._play(action)
        info = self._env.info
        over = self._is_over or self._is_another
        after = 0.0 if over else self._potential
        reward = self._reward
        if not info["n_inside"]:
            reward -= self._make.settings.step_cost
        reward += self._make.settings.gamma * after - before
        ends: dict[str, Any] = {}
        if over:
            ends = {
                "success": float(self._is_reached),
                "collision": float(info["collision"]),
                "return": self._return,
                "length": float(self._age),
            }
        return self._observation(), reward, over, False, {**self._counts(), **ends}

    def close(self) -> None:
        """Free the environment."""
        self._env.close()

    def _counts(self) -> dict[str, Any]:
        counts = {"episode": self._scene, "played": self._played, "actions": self._actions.copy()}
        return {**counts, **self._ladder.state_dict()}

    def _load(self) -> "Environment":
        """The task on the level that is due."""
        make, level = self._make, self._levels[self._ladder.level]
        return load(make.task, split=make.split, **{**make.options, **level})

    def _begin(self) -> None:
        """Begin the scene that is due, on the level that is due."""
        make = self._make
        if self._ladder.climb():
            self._env.close()
            self._env = self._load()
        scenario = make.seed * SCENES_A_SEED + make.part
        scenario += make.settings.environments * self._scene
        self._memory = self._network.start(1)
        self._actions, self._is_over, self._is_another = [], False, True
        self._turn()
        self._look(self._env.reset(scenario=scenario).observation)

    def _turn(self) -> None:
        """Turn to the next goal, if there is one."""
        if self._is_another:
            self._is_another, self._age, self._return = False, 0, 0.0

    def _fly(self) -> None:
        """Play until an action has an effect; mostly that is in this scene or in the next.

        Raises:
            PolicyError: In many there is none.
        """
        self._turn()
        for _ in range(MOST_FLIGHTS):
            if self._is_over:
                self._begin()
            while not self._is_over and not self._is_near():
                self._play(np.zeros(N_LENGTHS, np.float32))
            if not self._is_over:
                return
        make = self._make
        raise PolicyError(
            f"{make.folder} came within {make.settings.reach_m:g} m of the goal in none of "
            f"{MOST_FLIGHTS} scenes of {make.task}, so there is nothing to fine-tune"
        )

    def _play(self, action: npt.NDArray[np.float32]) -> None:
        """Play one control step, and note what came of it."""
        with one_torch_thread(), torch.inference_mode():
            share = torch.from_numpy(action)[None]
            command, self._memory = self._parts.respond(
                self._memory, self._sightings, self._inputs.state, share, self._inputs.felt
            )
        self._turn()
        goal, missed = self._env.goal().position, self._missed()
        time_step = self._env.step(command[0].numpy())
        self._reward = float(time_step.reward or 0.0)
        self._is_reached = bool(self._env.info["is_success"])
        if not self._is_reached and self._missed() < missed:
            self._reward += GOAL_REWARD
            self._is_reached = True
        self._played += 1
        self._actions.append(action.tolist())
        self._is_over = bool(time_step.last())
        self._is_another = float(np.linalg.norm(self._env.goal().position - goal)) > ANOTHER_M
        self._age += 1
        self._return += self._reward
        self._look(time_step.observation)
        if self._is_over:
            self._scene += 1
            self._ladder.note(bool(self._env.info["is_success"]))

    def _missed(self) -> float:
        """How many goals have not been reached, where there are several."""
        return sum(self._env.info["errors"][name] for name in self._counted)

    def _look(self, observation: Mapping[str, npt.NDArray[Any]]) -> None:
        self._inputs = inputs = network_inputs(self._network, self._config, observation)
        with one_torch_thread(), torch.inference_mode():
            self._memory, self._sightings, self._read = self._parts.perceive(
                inputs.images, inputs.state, self._memory, inputs.goal, inputs.felt
            )
        errors = self._env.info["errors"]
        relative = [errors[name] / bound for name, bound in self._step_bounds.items()]
        self._potential = -self._make.settings.shaping * float(np.arcsinh(relative).sum())

    def _is_near(self) -> bool:
        """Whether the tip is near the goal, and near where that is believed to be."""
        env = self._env
        if np.linalg.norm(env.goal().position - env.tip().position) > self._make.settings.reach_m:
            return False
        residual = self._network.residual
        assert residual is not None
        goal, _ = self._network.goal_frame(self._memory)
        return bool(residual.is_near(self._memory[:, FELT], goal))

    def _observation(self) -> Observation:
        env = self._env
        believed, axes = (each[0].numpy() for each in self._network.goal_frame(self._memory))
        believed = believed + self._memory[0, FELT][SHIFT].numpy()
        goal, coming = env.goal().position, env.goal(SOON_S).position
        ways = np.concatenate([goal - env.tip().position, goal - believed, coming - goal])
        info, spec = env.info, env.spec
        privileged = [
            np.arcsinh(ways.reshape(3, 3) @ axes / FINE_M).reshape(-1),
            [
                1.0 - env.control_steps / spec.time_limit_steps,
                self._age * spec.control_period_s / LONG_S,
                info["n_inside"] / spec.hold_steps,
            ],
            [np.arcsinh(info["errors"][name] / bound) for name, bound in self._bounds.items()],
        ]
        return {
            READ: self._read[0].numpy().copy(),
            PRIVILEGED: np.concatenate(privileged).astype(np.float32),
        }


@dataclasses.dataclass(frozen=True)
class MakeStage:
    """Makes one of a run's players; travels to its process.

    Attributes:
        task: Named task.
        options: Task options that differ from it.
        split: Stream of scenes.
        folder: Checkpoint that plays.
        settings: Of the run.
        seed: Of the run.
        part: Which of the players it is; they share the scenes between them.
        place: Where to begin.
        curriculum: See `hvs_suite.policies.rl.curriculum.levels_of`; None for the task alone.
    """

    task: str
    options: Mapping[str, Any]
    split: str
    folder: str
    settings: Settings
    seed: int
    part: int = 0
    place: Place = Place()
    curriculum: Kind | None = None

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of the task's metrics above 0, by name."""
        spec = find(self.task).with_options(self.options)
        return {metric.name: metric.bound for metric in spec.metrics if metric.bound}

    @property
    def n_privileged(self) -> int:
        """Numbers that only critics see."""
        return 3 * N_LENGTHS + 3 + len(self.bounds)

    def __call__(self) -> Stage:
        """Make it."""
        return Stage(self)
