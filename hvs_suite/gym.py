"""The named tasks as Gymnasium environments.

    import gymnasium
    import hvs_suite

    env = gymnasium.make("hvs_suite/align-thesis-v1", split="train")
    observation, info = env.reset(options={"scenario": 0})

The same tasks as ``hvs_suite/<name>-goal-v<version>`` are for hindsight replay, see `GoalEnv`.

Importing this module loads neither MuJoCo nor a renderer; making an environment compiles the
scene, and the renderer is made at the first reset, in whichever process that happens.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.registration import WrapperSpec

from hvs_suite.errors import OptionError
from hvs_suite.registry import TASKS, load
from hvs_suite.tasks.shared.goal import HEIGHT, LATERAL, POSITION, TILT, Goal, Tip, goal_errors

if TYPE_CHECKING:
    import dm_env

NAMESPACE = "hvs_suite"
RENDER_SIDE_PX = 480
_POSES = ("flange_position", "goal_position", "goal_normal")
"""Of the preset ``state``: what a goal environment shows as goals."""

Observation = dict[str, npt.NDArray[Any]]


class TaskEnv(gymnasium.Env[Any, npt.NDArray[np.float32]]):
    """A named task behind Gymnasium's interface.

    Observations are a flat ``Dict``: ``eih`` and ``eth`` uint8 (H, W, C), ``joint_positions``
    float32 (7,) in rad and ``joint_velocities`` float32 (7,) in rad/s for the named tasks, in the
    order and with the bounds of the task's own specification. Actions are ``Box(-1, 1, (7,))``
    (six numbers with ``action_mode="flange_twist"``). Finite values outside are clipped and
    counted in ``info["n_clipped"]``, because learned policies overshoot.

    ``terminated`` means goal or collision, ``truncated`` the time limit. ``info`` holds Python
    bools, ints and strings: ``is_success``, ``collision``, ``truncated``, ``split``, ``scenario``,
    ``steps`` and what else ``Environment.info`` has; ``errors`` maps the task's metrics to floats.

    Args:
        task: Registered name, such as ``align-thesis``.
        split: Stream of scenarios; ``test`` holds 1,000 frozen ones.
        render_mode: ``rgb_array``, or None where nothing is rendered for people.
        **options: Any option of the task, for studies.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An option does not exist or its value makes no sense.
        ScenarioError: The split's name is empty.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        split: str = "train",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise gymnasium.error.UnsupportedMode(
                f"render_mode {render_mode!r} is not supported; use 'rgb_array' or None"
            )
        self._environment = load(task, split=split, **options)
        self._environment.clip_actions = True
        self.render_mode = render_mode
        spec = self._environment.spec
        self.metadata = {**self.metadata, "render_fps": spec.fps}
        self.task = spec.name
        specification = self._environment.observation_spec()
        self._spaces: dict[str, spaces.Space[Any]] = {
            name: _space(spec) for name, spec in specification.items()
        }
        self.observation_space = spaces.Dict(self._spaces)
        action = self._environment.action_spec()
        self.action_space = spaces.Box(-1.0, 1.0, action.shape, np.float32)
        self._max_episode_steps: int = spec.time_limit_steps
        self._playing = False
        self._frame: npt.NDArray[np.uint8] | None = None

    @property
    def task_description(self) -> str:
        """The task of the present episode as one sentence."""
        return self._environment.instruction

    @property
    def environment(self) -> Any:
        """The ``dm_env`` environment behind this one, for what Gymnasium does not provide."""
        return self._environment

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Play scenario ``seed`` (mod 1,000 on ``test``); later bare resets walk a stream
                of their own that depends on the seed and their count alone.
            options: ``{"scenario": i}`` plays scenario i of the split; other keys are ignored.

        Returns:
            Observation and info.

        Raises:
            ScenarioError: The split has no such scenario.
        """
        super().reset(seed=seed)
        scenario = (options or {}).get("scenario")
        if scenario is None or seed is not None:
            time_step = self._environment.reset(seed=seed)
        if scenario is not None:
            time_step = self._environment.reset(scenario=scenario)
        self._playing = True
        return self._observation(time_step), self._info()

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Plays one control step.

        Args:
            action: Numbers (7,) or (6,); finite values outside [-1, 1] are clipped and counted.

        Returns:
            Observation, reward, terminated (goal or collision), truncated (time limit), info.

        Raises:
            ActionError: The action has NaN, infinity or a wrong shape.
            gymnasium.error.ResetNeeded: The episode is over, or none was started.
        """
        if not self._playing:
            raise gymnasium.error.ResetNeeded("no episode is running; call reset() first")
        time_step = self._environment.step(action)
        info = self._info()
        terminated = info["is_success"] or info["collision"]
        truncated = info["truncated"]
        self._playing = not (terminated or truncated)
        reward = 0.0 if time_step.reward is None else float(time_step.reward)
        return self._observation(time_step), reward, terminated, truncated, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The cell as RGB (480, 480, 3) uint8, drawn once a control step; None without a mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array'; nothing was drawn")
            return None
        if self._frame is None:
            self._frame = self._environment.render(RENDER_SIDE_PX, RENDER_SIDE_PX)
        return self._frame.copy()

    def close(self) -> None:
        """Frees the renderer; calling it again does nothing."""
        self._playing = False
        self._environment.close()

    def _observation(self, time_step: "dm_env.TimeStep") -> Observation:
        self._frame = None
        return {
            name: np.asarray(time_step.observation[name], dtype=space.dtype)
            for name, space in self._spaces.items()
        }

    def _info(self) -> dict[str, Any]:
        return {
            name: value.item() if isinstance(value, np.generic) else value
            for name, value in self._environment.info.items()
        }


def _space(spec: Any) -> spaces.Box:
    """The Gymnasium space of one ``dm_env`` observation; floats become float32."""
    dtype = np.uint8 if spec.dtype == np.uint8 else np.float32
    low = np.broadcast_to(spec.minimum, spec.shape).astype(dtype)
    high = np.broadcast_to(spec.maximum, spec.shape).astype(dtype)
    return spaces.Box(low, high, spec.shape, dtype)  # type: ignore[arg-type]


class GoalEnv(TaskEnv):
    """A named task for learners that replay in hindsight, such as Stable-Baselines3's HER.

    Observations have the three parts that such learners ask for, all float32 and privileged:
    ``observation``, the preset ``state`` without its goal, one vector; ``achieved_goal``, where the
    tool's tip is; ``desired_goal``, where it has to be: each a position (3,) in m and the direction
    of the tool's axis (3,), base frame.

    The reward is 1 at the end of a control step inside the task's bounds and without a collision,
    and 0 otherwise. It has to follow from the two goals alone, so it ignores holds of several steps
    and metrics over an episode; ``info["is_success"]`` counts them.

    Args:
        task: Registered name, such as ``align-thesis``.
        **options: As for `TaskEnv`, without ``observations`` and ``rewards``.

    Raises:
        OptionError: A bound of the task does not follow from where the tip is, or an option is one
            of those two.
    """

    def __init__(self, task: str, **options: Any) -> None:
        if fixed := sorted({"observations", "rewards"} & set(options)):
            raise OptionError(f"a goal environment has {fixed[0]} of its own; leave them out")
        super().__init__(task, observations="state", **options)
        self._bounds = self._environment.spec.step_bounds
        if foreign := sorted(set(self._bounds) - {POSITION, LATERAL, HEIGHT, TILT}):
            raise OptionError(
                f"{task} bounds {foreign[0]}, which does not follow from where the tip is; "
                f"use {NAMESPACE}/{task}-v{self._environment.spec.version}"
            )
        pose = [self._spaces[name] for name in ("flange_position", "goal_normal")]
        self._own = [name for name in self._spaces if name not in _POSES]
        own = [self._spaces[name] for name in self._own]
        self.observation_space = spaces.Dict(
            {
                "observation": _joined(own),
                "achieved_goal": _joined(pose),
                "desired_goal": _joined(pose),
            }
        )

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As `TaskEnv.step`, with the reward of `compute_reward`."""
        observation, _, terminated, truncated, info = super().step(action)
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        reward = float(self.compute_reward(achieved, desired, info))
        return observation, reward, terminated, truncated, info

    def compute_reward(
        self, achieved_goal: npt.NDArray[Any], desired_goal: npt.NDArray[Any], info: Any
    ) -> npt.NDArray[np.float32]:
        """Compare tips with goals, of any steps and episodes.

        Args:
            achieved_goal: Where the tip is, (6,) or (n, 6).
            desired_goal: Where it has to be, in the same shape.
            info: Of the step, or (n,) of them; ``collision`` is read where it is there.

        Returns:
            1 inside the bounds, 0 elsewhere, () or (n,).
        """
        one = achieved_goal.ndim == 1
        achieved = np.atleast_2d(achieved_goal).astype(np.float64)
        desired = np.atleast_2d(desired_goal).astype(np.float64)
        rewards = np.zeros(len(achieved), np.float32)
        for i, known in enumerate([info] if one else info):
            tip = Tip(achieved[i, :3], achieved[i, 3:])
            errors = goal_errors(tip, Goal(desired[i, :3], -desired[i, 3:]))
            inside = all(abs(errors[name]) <= bound for name, bound in self._bounds.items())
            rewards[i] = inside and not known.get("collision", False)
        return rewards[0] if one else rewards

    def _observation(self, time_step: "dm_env.TimeStep") -> Observation:
        state = super()._observation(time_step)
        tip, goal = self._environment.tip(), self._environment.goal()
        return {
            "observation": np.concatenate([state[name] for name in self._own]),
            "achieved_goal": np.concatenate([tip.position, tip.axis]).astype(np.float32),
            "desired_goal": np.concatenate([goal.position, -goal.normal]).astype(np.float32),
        }


def _joined(parts: Sequence[spaces.Space[Any]]) -> spaces.Box:
    """The space of several vectors in one."""
    boxes = [cast(spaces.Box, part) for part in parts]
    low, high = (np.concatenate([getattr(box, end) for box in boxes]) for end in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


class OwnTimeLimit(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Tells Gymnasium when the environment itself ends an episode: ``spec.max_episode_steps``.

    Gymnasium's own time limit is not added, so that a goal on the last step terminates the episode
    without truncating it. A shorter ``max_episode_steps`` of `gymnasium.make` adds it.

    Args:
        env: A `TaskEnv`, wrapped by `gymnasium.make`.

    Raises:
        OptionError: A longer limit was asked for, which the environment would not reach.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        task = cast(TaskEnv, env.unwrapped)
        assert task.spec is not None
        limit = task.environment.spec.time_limit_steps
        # Before anything else: wrappers copy the spec when they are asked for it.
        task.spec.max_episode_steps = limit
        asked = None if env.spec is None else env.spec.max_episode_steps
        if asked is not None and asked > limit:
            raise OptionError(
                f"max_episode_steps is {asked}, and {task.task} ends after {limit}; use "
                f"time_limit_steps={asked}"
            )


class PixelsAgentPos(gymnasium.Wrapper[Any, Any, Observation, Any]):
    """The same environment with the observations that LeRobot's environments have.

    ``pixels`` holds the camera images by name, uint8 (H, W, 3); ``agent_pos`` the measured joint
    positions (rad), then velocities (rad/s), float32 (14,); what else the task's family shows
    keeps its name.

    Args:
        env: An :class:`TaskEnv`.

    Raises:
        OptionError: The task's images are not uint8 RGB, which is all that LeRobot takes.
    """

    def __init__(self, env: TaskEnv) -> None:
        super().__init__(env)
        inner = cast(spaces.Dict, env.observation_space)
        cameras = {name: space for name, space in inner.items() if len(space.shape or ()) == 3}
        for name, space in cameras.items():
            if space.dtype != np.uint8 or (space.shape or (0,))[-1] != 3:
                raise OptionError(
                    f"LeRobot takes uint8 RGB images, and {name} is {space.dtype} "
                    f"{space.shape}: leave out depth, grey and normalised images."
                )
        self._cameras = tuple(cameras)
        self._vectors = tuple(
            name for name in ("joint_positions", "joint_velocities") if name in inner.spaces
        )
        view: dict[str, spaces.Space[Any]] = {"pixels": spaces.Dict(cameras)}
        if self._vectors:
            view["agent_pos"] = _joined([inner[name] for name in self._vectors])
        self._further = tuple(
            n for n in env.environment.spec.further_observations if n in inner.spaces
        )
        view |= {name: inner[name] for name in self._further}
        self.observation_space = spaces.Dict(view)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As :meth:`TaskEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._view(observation), info

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """As :meth:`TaskEnv.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._view(observation), float(reward), terminated, truncated, info

    def _view(self, observation: Observation) -> dict[str, Any]:
        view: dict[str, Any] = {"pixels": {name: observation[name] for name in self._cameras}}
        if self._vectors:
            view["agent_pos"] = np.concatenate([observation[name] for name in self._vectors])
        view |= {name: observation[name] for name in self._further}
        return view


def make_pixels_agent_pos(task: str, **options: Any) -> PixelsAgentPos:
    """Makes the LeRobot view of a named task; importable by worker processes without LeRobot."""
    return PixelsAgentPos(TaskEnv(task, **options))


def register() -> None:
    """Registers every named task, as it is and for hindsight replay; again does nothing."""
    own_limit = WrapperSpec("OwnTimeLimit", "hvs_suite.gym:OwnTimeLimit", {})
    for name, spec in TASKS.items():
        for kind, environment in (("", "TaskEnv"), ("-goal", "GoalEnv")):
            identifier = f"{NAMESPACE}/{name}{kind}-v{spec.version}"
            if identifier not in gymnasium.registry:
                gymnasium.register(
                    identifier,
                    # A string, so that registering imports nothing.
                    f"hvs_suite.gym:{environment}",
                    additional_wrappers=(own_limit,),
                    kwargs={"task": name},
                )
