"""The named tasks as Gymnasium environments.

    import gymnasium
    import hvs_suite

    env = gymnasium.make("hvs_suite/align-thesis-v1", split="train")
    observation, info = env.reset(options={"scenario": 0})

Importing this module loads neither MuJoCo nor a renderer; making an environment compiles the
scene, and the renderer is made at the first reset, in whichever process that happens.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from hvs_suite.errors import OptionError
from hvs_suite.registry import TASKS, load

if TYPE_CHECKING:
    import dm_env

NAMESPACE = "hvs_suite"
RENDER_SIDE_PX = 480

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
        """The ``dm_env`` environment behind this one, for what Gymnasium has no name for."""
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
            boxes = [cast(spaces.Box, inner[name]) for name in self._vectors]
            view["agent_pos"] = spaces.Box(
                np.concatenate([box.low for box in boxes]),
                np.concatenate([box.high for box in boxes]),
                dtype=np.float32,
            )
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
    """Registers ``hvs_suite/<name>-v<version>`` for every named task; again does nothing."""
    for name, spec in TASKS.items():
        identifier = f"{NAMESPACE}/{name}-v{spec.version}"
        if identifier not in gymnasium.registry:
            # A string, so that registering imports nothing; time limit and order of calls are the
            # environment's own.
            gymnasium.register(identifier, "hvs_suite.gym:TaskEnv", kwargs={"task": name})
