"""The environment loop: composer's contract, a faster step, scenarios by index, one renderer.

What differs from ``composer.Environment``, and why:

* the substep loop runs on MuJoCo's raw pointers, three times faster than composer's;
* a forbidden contact in *any* physics substep is latched and ends the step: a tool tip can move
  12 cm in a control step, so looking only at its end would miss it;
* each substep ends with ``mj_step1``, so that poses, contacts and pictures belong to the same joint
  positions;
* time is counted in whole control steps;
* nothing is drawn before the first ``reset``, so that processes may fork until then.
"""

import hvs_suite.cell  # noqa: F401 - chooses the OpenGL backend before MuJoCo is imported

# isort: split
import dataclasses
import weakref
from collections.abc import Mapping, Sequence
from typing import Any, Self

import dm_env
import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import composer
from dm_env import specs

from hvs_suite.cell.cameras import CameraImage
from hvs_suite.cell.physics import Physics
from hvs_suite.cell.renderer import Renderer
from hvs_suite.cell.solid import Solid
from hvs_suite.errors import ScenarioError
from hvs_suite.tasks.shared.arm_task import ArmTask
from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.scenario import Scenario
from hvs_suite.tasks.shared.spec import Spec

FloatArray = npt.NDArray[np.float64]
Observation = dict[str, npt.NDArray[Any]]

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclasses.dataclass(frozen=True, eq=False)
class Moment:
    """All that changes in a scene during an episode.

    Attributes:
        steps: Control steps since the reset.
        state: MuJoCo's full state, mocap bodies included, (n,).
    """

    steps: int
    state: FloatArray


class Environment(composer.Environment):
    """A ``composer.Environment`` whose episodes are scenarios with an index.

    Attributes:
        clip_actions: Clip and count action values outside [-1, 1] instead of refusing them.
        goal_ends_episode: False lets an episode go on past its goal to the time limit, to show
            where a policy settles. Never changes a scene.
        draws: False leaves pictures out of the time steps, for callers that need none or draw them
            later by ``pictures``. Never changes a scene.

    Args:
        task: The task.
        seed: Start of the stream that bare ``reset()`` calls walk; None draws one.
    """

    def __init__(self, task: ArmTask, seed: int | None = None) -> None:
        self.clip_actions = False
        self.goal_ends_episode = True
        self.draws = True
        self._physics: Any = None
        self._renderer: Renderer | None = None
        self._studio: dict[int, Renderer] = {}
        self._control_steps = 0
        self._seed = (
            int(np.random.SeedSequence().generate_state(1, np.uint32)[0]) if seed is None else seed
        )
        self._count = 0
        self._arm = task
        super().__init__(
            task, recompile_mjcf_every_episode=False, legacy_step=False, random_state=0
        )
        self._mjcf_never_compiled = False

    # --- dm_env ---------------------------------------------------------------------------------

    def reset(self, *, scenario: int | None = None, seed: int | None = None) -> dm_env.TimeStep:
        """Start an episode.

        Args:
            scenario: Index of the scenario to play; leaves the stream of bare resets alone.
            seed: Play scenario ``seed`` (mod 1,000 on ``test``) and start a new stream from it.

        Returns:
            The first time step.

        Raises:
            ScenarioError: The index or seed is negative, not whole or beyond the split.
        """
        if scenario is None:
            if seed is not None:
                if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
                    raise ScenarioError(f"a seed is a whole number from 0 up, not {seed!r}")
                self._seed, self._count = int(seed), 0
            scenario = self._arm.seeded_index(self._seed, self._count)
            self._count += 1
        self._arm.prepare(scenario)
        self._control_steps = 0
        with self._physics.reset_context():
            self._hooks.initialize_episode(self._physics_proxy, self._random_state)
        data = self._physics.data.ptr
        mujoco.mj_step1(self._physics.model.ptr, data)
        self._upload_textures()
        self._reset_next_step = False
        return dm_env.restart(self._observe())

    def step(self, action: npt.ArrayLike) -> dm_env.TimeStep:
        """Run one control step.

        Args:
            action: As in ``action_spec``.

        Returns:
            The time step; after the last of an episode this starts the next one, as in dm_env.

        Raises:
            ActionError: The action has NaN, infinity, a wrong shape, or leaves [-1, 1].
        """
        if self._reset_next_step:
            return self.reset()
        physics = self._physics_proxy
        self._hooks.before_step(physics, action, self._random_state)
        model, data = self._physics.model.ptr, self._physics.data.ptr
        task = self._arm
        finish, begin = mujoco.mj_step2, mujoco.mj_step1
        collided, touches = False, data.ncon
        for _ in range(self._n_sub_steps):
            finish(model, data)
            begin(model, data)
            touched, touches = touches, data.ncon
            if (touched or touches) and task.is_forbidden(physics):
                collided = True
                break
        self._control_steps += 1
        task.finish_step(
            physics,
            steps=self._control_steps,
            collided=collided,
            at_time_limit=self._control_steps >= task.time_limit_steps,
        )
        self._hooks.after_step(physics, self._random_state)
        reward = task.get_reward(physics)
        discount = task.get_discount(physics)
        self._reset_next_step = task.has_ended
        kind = dm_env.StepType.LAST if task.has_ended else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, self._observe())

    def observation_spec(self) -> dict[str, specs.Array]:
        """Shapes, types and bounds of the observations, known without drawing anything."""
        return {
            name: item.array_spec.replace(name=name)
            for name, item in self._arm.observables.items()
            if item.enabled
        }

    def action_spec(self) -> specs.BoundedArray:
        """Seven (or six) numbers in [-1, 1]."""
        return self._arm.action_spec(self._physics_proxy)

    def close(self) -> None:
        """Free renderers and physics; calling it again does nothing."""
        for renderer in (self._renderer, *self._studio.values()):
            if renderer is not None:
                renderer.close()
        self._renderer = None
        self._studio = {}
        if self._physics is not None:
            self._physics.free()
            self._physics = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # --- what the suite adds --------------------------------------------------------------------

    @property
    def control_steps(self) -> int:
        """Control steps since the last reset."""
        return self._control_steps

    @property
    def info(self) -> dict[str, Any]:
        """Outcome so far; keys as in ``ArmTask.info``, and ``steps``."""
        return {**self._arm.info(), "steps": self._control_steps}

    def judge(self, share: float, steps: int) -> tuple[Any, ...]:
        """How a control step would be judged; see ``ArmTask.judge_at``."""
        return self._arm.judge_at(self._physics_proxy, share, steps)

    @property
    def slack(self) -> Mapping[str, float]:
        """What is added to each step bound, by unit; nothing but for re-simulation."""
        return self._arm.slack

    @slack.setter
    def slack(self, slack: Mapping[str, float]) -> None:
        self._arm.slack = slack

    @property
    def spec(self) -> Spec:
        """The task's parameters."""
        return self._arm.spec

    @property
    def split(self) -> str:
        """Name of the stream of scenarios."""
        return self._arm.source.split

    @property
    def scenario(self) -> Scenario:
        """The scenario being played."""
        return self._arm.scenario

    @property
    def joint_positions(self) -> FloatArray:
        """True joint angles, (7,) rad."""
        return self._arm.joint_positions(self._physics_proxy)

    @property
    def joint_velocities(self) -> FloatArray:
        """True joint speeds, (7,) rad/s."""
        return self._arm.joint_velocities(self._physics_proxy)

    @property
    def setpoint(self) -> FloatArray:
        """True joint set point that the controller tracks now, (7,) rad."""
        return self._arm.setpoint(self._physics_proxy)

    @property
    def pending_setpoints(self) -> list[FloatArray]:
        """True set points that were commanded but do not act yet (latency), oldest first."""
        return self._arm.pending_setpoints()

    @property
    def instruction(self) -> str:
        """The task of this episode as one sentence; the sentence that fits all before a reset."""
        return self._arm.instruction

    @property
    def obstacles(self) -> tuple[Solid, ...]:
        """What the arm must keep out of beside the surface."""
        return self._arm.family.obstacles()

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Where the tool's tip has to be now, or some time from now (s)."""
        return self._arm.goal(ahead_s)

    def tip(self) -> Tip:
        """Where the tool's tip is now."""
        return self._arm.tip(self._physics_proxy)

    @property
    def distance_m(self) -> float:
        """How far the tip is from its goal (m)."""
        return self._arm.distance_m(self._physics_proxy)

    def commandable(self, q: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The ``joint_position`` action that sends the arm to true joint angles (7,) rad."""
        return self._arm.commandable(q)

    @property
    def landing_mm(self) -> FloatArray:
        """Where the flange axis stands over the target now, (2,) mm; see ``ArmTask.landing_mm``."""
        return self._arm.landing_mm(self._physics_proxy)

    def privileged(self) -> dict[str, FloatArray]:
        """What only training and the expert may see; keys as in ``ArmTask.privileged``."""
        return self._arm.privileged(self._physics_proxy)

    @property
    def renderer(self) -> Renderer:
        """The kept renderer of the task's own cameras, made when first asked for."""
        if self._renderer is None:
            self._renderer = Renderer(
                self._physics.model.ptr, self._arm.camera_side, self._arm.multisampling
            )
            self._upload_textures()
        return self._renderer

    def render(
        self, width: int = 480, height: int = 480, camera: str = "cell"
    ) -> npt.NDArray[np.uint8]:
        """Draw a picture for people, with shadows and smooth edges.

        Args:
            width: Columns (px).
            height: Rows (px).
            camera: ``cell`` for a third-person view, or ``eih`` or ``eth``.

        Returns:
            RGB, uint8 (H, W, 3).
        """
        side = max(width, height)
        if side not in self._studio:
            renderer = Renderer(self._physics.model.ptr, side, 4, studio=True)
            self._studio[side] = renderer
            for texture in self._arm.textures_to_upload():
                renderer.upload_texture(texture)
        view = self._arm.view(self._physics_proxy, camera)
        return self._studio[side].colour(self._physics.data.ptr, view, height, width)

    def moment(self) -> Moment:
        """What ``pictures`` needs to know of the present."""
        model, data = self._physics.model.ptr, self._physics.data.ptr
        state = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, state, _STATE)
        return Moment(self._control_steps, state)

    def _return_to(self, moment: Moment) -> None:
        """Put the model's state back to a moment; what follows from it is not computed."""
        self._control_steps = moment.steps
        mujoco.mj_setState(self._physics.model.ptr, self._physics.data.ptr, moment.state, _STATE)

    def pictures(self, moments: Sequence[Moment]) -> dict[str, list[npt.NDArray[Any]]]:
        """Draw what the cameras showed at moments of this episode, exactly as observed then.

        For a policy that does not look, drawing later is faster: all pictures of an episode at once
        take less time than between physics and decisions.

        Args:
            moments: Of ``moment``, since the last reset.

        Returns:
            Observed pictures by name, one a moment; the environment is left as it was.
        """
        model, data = self._physics.model.ptr, self._physics.data.ptr
        cameras = {
            name: item
            for name, item in self._arm.observables.items()
            if item.enabled and isinstance(item, CameraImage)
        }
        drawn: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in cameras}
        present = self.moment()
        try:
            for moment in moments:
                self._return_to(moment)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                for name, item in cameras.items():
                    drawn[name].append(item(self._physics_proxy, self._random_state))
        finally:
            self._return_to(present)
            mujoco.mj_step1(model, data)
        return drawn

    def _observe(self) -> Observation:
        physics, random_state = self._physics_proxy, self._random_state
        return {
            name: item(physics, random_state)
            for name, item in self._arm.observables.items()
            if item.enabled and (self.draws or not isinstance(item, CameraImage))
        }

    def _upload_textures(self) -> None:
        for drawer in (self._renderer, *self._studio.values(), self._physics):
            if drawer is not None:
                for texture in self._arm.textures_to_upload():
                    drawer.upload_texture(texture)

    def _recompile_physics(self) -> None:
        if self._physics is not None:
            self._physics.free()
        self._physics = Physics.from_mjcf_model(self._task.root_entity.mjcf_model)
        self._physics.legacy_step = self._legacy_step

    def _recompile_physics_and_update_observables(self) -> None:
        # Composer draws every camera here, once before the first reset; we must not (see above).
        self._physics_proxy = None
        self._recompile_physics()
        self._physics_proxy = weakref.proxy(self._physics)
        self._n_sub_steps = self._task.physics_steps_per_control_step
        self._hooks.refresh_entity_hooks()
        self._hooks.after_compile(self._physics_proxy, self._random_state)
        self._arm.environment = weakref.proxy(self)
