"""The task that all families share: arm, set points, latency, cameras, hold, outcome and info.

`ArmTask` is what `dm_control` plays. The family, an object with a few methods, defines what is
special about a task (see `hvs_suite.tasks.shared.family`).
"""

import hvs_suite.cell  # noqa: F401 - chooses the OpenGL backend before MuJoCo is imported

# isort: split
from collections.abc import Mapping
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf
from dm_env import specs

from hvs_suite.cell import cameras
from hvs_suite.cell.arena import Cell
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.renderer import Renderer
from hvs_suite.cell.robot import (
    JOINT_ACCELERATION_RAD_S2,
    JOINT_RANGE_RAD,
    JOINT_SPEED_RAD_S,
    SHELL_GROUP,
)
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import actions, appearance, observations, rewards
from hvs_suite.tasks.shared.family import Family, Progress
from hvs_suite.tasks.shared.goal import (
    HEIGHT,
    LATERAL,
    POSITION,
    TILT,
    Goal,
    Keypoint,
    Tip,
    goal_errors,
)
from hvs_suite.tasks.shared.scenario import Scenario, ScenarioSource, StepStream
from hvs_suite.tasks.shared.spec import CAMERA_NAMES, Spec
from hvs_suite.tasks.shared.strewn import Strewn

FloatArray = npt.NDArray[np.float64]

# A ray that ends this close to the target's centre met the target, not something before it.
_RAY_SLACK_M = 0.003


class Stage(Protocol):
    """What the task needs of the environment that plays it."""

    clip_actions: bool
    goal_ends_episode: bool

    @property
    def control_steps(self) -> int:
        """Control steps since the last reset."""

    @property
    def renderer(self) -> Renderer:
        """The kept renderer of the task's own cameras."""


class ArmTask(composer.Task):
    """A family's task; one object plays any scenario of its split.

    Args:
        family: What is special about the task.
        split: Name of the stream of scenarios.

    Attributes:
        spec: All parameters.
        family: What is special about the task.
        source: Draws its scenarios.
        cameras: Cameras of the compiled model by name.
        time_limit_steps: Control steps after which an episode is truncated.
        camera_side: Side of the largest picture that the task observes (px).
        multisampling: Samples per pixel.
        environment: The environment that plays the task, set by it.

    Raises:
        OptionError: The control period is no multiple of the physics timestep, or a goal that was
            asked for is out of reach.
        ScenarioError: The split's name is empty.
    """

    environment: Stage

    def __init__(self, family: Family[Any, Any], split: str = "train") -> None:
        spec: Spec = family.spec
        self.spec = spec
        self.family = family
        self._cell = Cell(
            embodiment=spec.embodiment,
            surface=family.surface(),
            eih_fov_deg=spec.eih_fov_deg,
            eth_fov_deg=spec.eth_fov_deg,
            eth_position_m=spec.eth_position_m,
            eth_look_at_m=spec.eth_look_at_m,
        )
        family.build(self._cell)
        self._strewn = Strewn(self._cell, spec) if spec.n_strewn else None
        self.source = ScenarioSource(spec, family.named, split, family.draw)
        self._action_noise = StepStream(self.source, "noise-action")
        self.time_limit_steps = spec.time_limit_steps
        self.camera_side = max(spec.eih_resolution, spec.eth_resolution)
        self.multisampling = spec.multisampling
        timestep = float(self._cell.mjcf_model.option.timestep)
        substeps = spec.control_period_s / timestep
        if round(substeps) < 1 or abs(substeps - round(substeps)) > 1e-6:
            raise OptionError(
                f"control_period_s is {spec.control_period_s}; use a whole multiple of the "
                f"physics timestep of 1/{1.0 / timestep:.0f} s"
            )
        self.set_timesteps(control_timestep=spec.control_period_s, physics_timestep=timestep)
        self._observables = observations.make_observables(self)
        self._bounded = tuple(m for m in spec.metrics if m.over == "step" and m.bound is not None)
        self.slack = {}
        self._is_shaped = bool(rewards.OF_ERRORS & set(spec.rewards))
        self._scenario: Scenario | None = None
        self._goal_configurations: FloatArray | None = None
        self._errors: dict[str, float] = {}
        self._reward_terms: dict[str, float] = {}
        self._n_inside = 0
        self._inside_once = False
        self._steps_to_goal: int | None = None
        self._clear_outcome()

    # --- composer -------------------------------------------------------------------------------

    @property
    def root_entity(self) -> composer.Entity:
        """The cell."""
        return self._cell

    @property
    def slack(self) -> Mapping[str, float]:
        """What is added to each step bound, by the metric's unit; nothing as a rule."""
        return self._slack

    @slack.setter
    def slack(self, slack: Mapping[str, float]) -> None:
        self._slack = slack
        self._step_bounds = tuple(
            (metric.name, metric.bound + slack.get(metric.unit, 0.0))
            for metric in self._bounded
            if metric.bound is not None
        )

    @property
    def observables(self) -> dict[str, Any]:
        """Observables by name: exactly the spec's observations, all enabled."""
        return self._observables

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Look up indices in the compiled model once."""
        del random_state
        cell, spec = self._cell, self.spec
        robot = cell.robot
        joints = physics.bind(robot.joints)
        self._qpos = np.array(joints.qposadr, int).ravel()
        self._qvel = np.array(joints.dofadr, int).ravel()
        self._actuators = np.array(physics.bind(robot.actuators).element_id, int).ravel()
        self._act = physics.model.actuator_actadr[self._actuators].copy()
        self._flange = int(physics.bind(robot.flange).element_id)
        self._tip = int(physics.bind(robot.tip).element_id)
        self._flange_body = int(physics.bind(robot.flange_body).element_id)
        self.cameras = {
            name: cameras.Camera(
                name,
                int(physics.bind(getattr(cell, name)).element_id),
                getattr(spec, f"{name}_resolution"),
                getattr(spec, f"{name}_channels"),
                getattr(spec, f"{name}_fov_deg"),
            )
            for name in CAMERA_NAMES
        }
        self.family.after_compile(physics)
        if self._strewn is not None:
            self._strewn.after_compile(physics)
        self._appearance = appearance.Appearance(physics, cell, spec)
        self._rays = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._rays[: SHELL_GROUP + 1] = 1
        self._near_m = float(physics.model.vis.map.znear * physics.model.stat.extent)

    def prepare(self, index: int) -> None:
        """Draw scenario ``index``."""
        self._scenario = self.source.draw(index)

    def seeded_index(self, seed: int, count: int) -> int:
        """As in ``ScenarioSource.seeded_index``."""
        return self.source.seeded_index(seed, count)

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        """Set the state and the look of the drawn scenario; nothing of earlier ones remains."""
        del random_state
        scenario = self.scenario
        data = physics.data.ptr
        data.qpos[self._qpos] = scenario.start
        # The set point starts where the arm is: MuJoCo's default of 0 would throw it.
        data.act[self._act] = scenario.start
        self.family.begin(physics, scenario)
        if self._strewn is not None:
            streams = self.source.streams(scenario.index)
            self._strewn.lay(physics, streams, self.family.occupied())
        self._appearance.apply(physics, scenario)
        start = scenario.start + scenario.joint_offset
        self._queue = [start.copy() for _ in range(self.spec.latency_steps)]
        self._commanded = start
        self._speed = np.zeros(len(start))
        self._clear_outcome()
        self._goal_configurations = None
        if "joint_space" in self.spec.rewards:
            goal = self.goal()
            model = kinematics(self.spec.embodiment)
            self._goal_configurations = model.goal_configurations(goal.position, goal.normal)
        mujoco.mj_kinematics(physics.model.ptr, data)
        self._errors = self.family.measure(self.tip(physics)) | self.family.at_reset()

    def before_step(
        self, physics: mjcf.Physics, action: Any, random_state: np.random.RandomState
    ) -> None:
        """Turn the action into the speed of the set point for this control step."""
        del random_state
        spec = self.spec
        values, clipped = actions.check_action(
            action, spec.action_mode, clip=self.environment.clip_actions
        )
        self._n_clipped += clipped
        if spec.action_noise > 0:
            random = self._action_noise.at(self.scenario.index, self.environment.control_steps)
            values = values + spec.action_noise * random.normal(size=values.shape)
            values = np.clip(values, -1.0, 1.0)
        self._commanded = actions.set_point(
            values, spec.action_mode, self._commanded, spec.control_period_s
        )
        self._queue.append(self._commanded)
        data = physics.data.ptr
        true_target = self._queue.pop(0) - self.scenario.joint_offset
        distance = true_target - data.act[self._act]
        speed = distance / spec.control_period_s
        if spec.acceleration_limits:
            speed = _accelerate(self._speed, distance, spec.control_period_s)
        self._speed = np.minimum(np.maximum(speed, -JOINT_SPEED_RAD_S), JOINT_SPEED_RAD_S)
        data.ctrl[self._actuators] = self._speed

    def is_forbidden(self, physics: mjcf.Physics) -> bool:
        """Whether a contact that exists now must never happen."""
        return self.family.is_forbidden(physics)

    def finish_step(
        self, physics: mjcf.Physics, *, steps: int, collided: bool, at_time_limit: bool
    ) -> None:
        """Let the scene move on, measure errors, and judge the control step."""
        self.family.advance(physics, steps * self.spec.control_period_s)
        self._judge(physics, self.tip(physics), steps, collided=collided, over=at_time_limit)
        self._reward_terms = rewards.reward_terms(self.spec, self._step_outcome(physics))

    def judge_at(self, physics: mjcf.Physics, share: float, steps: int) -> tuple[Any, ...]:
        """How a control step would be judged that ended with the tip beside its goal.

        For the version lock, which covers the rule of success: the arm stays where it is.

        Args:
            physics: The compiled cell.
            share: Distance from the goal along the surface, in units of the position's bound.
            steps: Control steps since the reset.

        Returns:
            ``(n_inside, is_success, truncated, steps_to_goal)``.
        """
        self.family.advance(physics, steps * self.spec.control_period_s)
        goal, bounds = self.goal(), self.spec.step_bounds
        bound_mm = bounds.get(POSITION, bounds.get(LATERAL, 1.0))
        along = np.cross(goal.normal, [0.0, 1.0, 0.0])
        away = 1e-3 * share * bound_mm * along / np.linalg.norm(along)
        tip = Tip(goal.position + away, -goal.normal)
        at_limit = steps >= self.time_limit_steps
        self._judge(physics, tip, steps, collided=False, over=at_limit)
        return self._n_inside, self._success, self._truncated, self._steps_to_goal

    def _judge(
        self, physics: mjcf.Physics, tip: Tip, steps: int, *, collided: bool, over: bool
    ) -> None:
        """Measure errors, count the hold, decide success, collision and truncation."""
        family = self.family
        errors = family.measure(tip)
        inside = not collided and all(
            abs(errors[name]) <= bound for name, bound in self._step_bounds
        )
        self._n_inside = self._n_inside + 1 if inside else 0
        self._inside_once = self._inside_once or inside
        self._collision = collided
        progress = Progress(steps, inside, self._n_inside)
        self._errors = errors | family.tally(physics, errors, progress)
        self._success = not collided and family.is_complete(progress)
        self._steps_to_goal = family.steps_to_goal(progress) if self._success else None
        time_is_up = over or family.is_over(progress)
        self._truncated = time_is_up and not self._is_final

    def _step_outcome(self, physics: mjcf.Physics) -> rewards.StepOutcome:
        """What the rewards of the control step depend on; costly parts only where asked for."""
        distance_m = lateral_m = height_m = tilt_deg = joint_distance = None
        if self._is_shaped:
            errors = goal_errors(self.tip(physics), self.goal())
            distance_m, tilt_deg = errors[POSITION] / 1000.0, errors[TILT]
            lateral_m, height_m = errors[LATERAL] / 1000.0, abs(errors[HEIGHT]) / 1000.0
        if self._goal_configurations is not None:
            joint_distance = rewards.joint_distance(
                self.joint_positions(physics), self._goal_configurations
            )
        return rewards.StepOutcome(
            success=self._success,
            collision=self._collision,
            truncated=self._truncated,
            distance_m=distance_m,
            lateral_m=lateral_m,
            height_m=height_m,
            tilt_deg=tilt_deg,
            joint_distance=joint_distance,
        )

    def get_reward(self, physics: mjcf.Physics) -> float:
        """Sum of the reward terms of the last control step."""
        del physics
        return float(sum(self._reward_terms.values()))

    def get_discount(self, physics: mjcf.Physics) -> float:
        """0 after goal or collision; truncation keeps the discount."""
        del physics
        return 0.0 if self._is_final else self.spec.discount

    @property
    def has_ended(self) -> bool:
        """Goal (unless the environment plays on), collision or time limit."""
        return self._is_final or self._truncated

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """Goal or collision; the time limit is the environment's."""
        del physics
        return self._is_final

    @property
    def _is_final(self) -> bool:
        ends = self.environment.goal_ends_episode or not self.spec.plays_on
        return self._collision or (self._success and ends)

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """Numbers in [-1, 1]; meaning in ``actions.set_point``."""
        del physics
        return actions.action_spec(self.spec.action_mode)

    def textures_to_upload(self) -> tuple[int, ...]:
        """The surface's texture, where the spec repaints it."""
        return self._appearance.changed_textures

    # --- what people ask ------------------------------------------------------------------------

    @property
    def scenario(self) -> Scenario:
        """The scenario being played."""
        if self._scenario is None:
            raise RuntimeError("reset the environment first")
        return self._scenario

    @property
    def instruction(self) -> str:
        """The task as one sentence; the one that fits all scenarios before the first reset."""
        return self.spec.instruction(self._scenario)

    @property
    def reward_terms(self) -> dict[str, float]:
        """Reward terms of the last control step by name."""
        return dict(self._reward_terms)

    @property
    def errors(self) -> dict[str, float]:
        """Every metric of the spec at the end of the last control step, without sign."""
        return {name: abs(value) for name, value in self._errors.items()}

    def info(self) -> dict[str, Any]:
        """Outcome so far.

        Returns:
            ``task`` and ``split`` (str), ``scenario`` (int), ``is_success``, ``success_once``
            (inside tolerance at any control step's end), ``steps_to_goal`` (int, None without
            success), ``collision``, ``truncated`` (bool), ``overload`` (bool: the collision that
            ended the episode was a breach of a limit on a metric, such as too much force),
            ``n_inside`` (control steps held so far), ``n_clipped`` (actions clipped) and
            ``errors``: every metric of the spec at the end of the last control step, by name.
        """
        return {
            "task": self.spec.name,
            "split": self.source.split,
            "scenario": self.scenario.index,
            "is_success": self._success,
            "success_once": self._inside_once,
            "steps_to_goal": self._steps_to_goal,
            "collision": self._collision,
            "truncated": self._truncated,
            "overload": self._collision and self.spec.is_overload(self._errors),
            "n_inside": self._n_inside,
            "n_clipped": self._n_clipped,
            "errors": self.errors,
        }

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Where the tip has to be now, or some time from now (s)."""
        return self.family.goal(ahead_s)

    def tip(self, physics: mjcf.Physics) -> Tip:
        """Where the tool tip is now."""
        data = physics.data.ptr
        # Copies, because MuJoCo changes its arrays in place.
        return Tip(data.site_xpos[self._tip].copy(), data.site_xmat[self._tip][2::3].copy())

    def distance_m(self, physics: mjcf.Physics) -> float:
        """How far the tip is from its goal (m)."""
        return goal_errors(self.tip(physics), self.goal())[POSITION] / 1000.0

    def privileged(self, physics: mjcf.Physics) -> dict[str, FloatArray]:
        """What only training and the expert may see.

        Returns:
            ``joint_positions`` (7,) true, rad; ``joint_offset`` (7,) rad; ``goal_position`` (3,) m,
            of the tip; ``goal_normal`` (3,); ``target_position`` (3,) m; for each keypoint and
            camera ``<keypoint>_<camera>`` (4,): u, v of its centre in [-1, 1] over the image (x
            right, y down), apparent diameter in image widths, and 1 where it can be seen, else 0
            (u, v and diameter are then 0); what the family adds; and its further observations,
            without noise.
        """
        goal = self.goal()
        return {
            "joint_positions": self.joint_positions(physics),
            "joint_offset": self.scenario.joint_offset.copy(),
            "goal_position": goal.position.copy(),
            "goal_normal": goal.normal.copy(),
            "target_position": goal.target.copy(),
            **{
                f"{name}_{camera}": self.in_image(physics, keypoint, camera)
                for name, keypoint in self.family.keypoints().items()
                for camera in CAMERA_NAMES
            },
            **self.family.privileged(),
            **self.family.observe(physics),
        }

    def in_image(self, physics: mjcf.Physics, keypoint: Keypoint, name: str) -> FloatArray:
        """Where a keypoint appears in a camera, (4,); see ``privileged``."""
        camera = self.cameras[name]
        data = physics.data.ptr
        centre = keypoint.position
        eye = data.cam_xpos[camera.id]
        # ``cameras.project`` in plain floats: this is asked for every frame that is recorded.
        ax, ay, az, bx, by, bz, cx, cy, cz = data.cam_xmat[camera.id].tolist()
        dx, dy, dz = (centre - eye).tolist()
        depth = -(az * dx + bz * dy + cz * dz)
        # What is nearer than the near plane is not drawn; an eye may sit within its own bracket.
        if depth <= self._near_m:
            return np.zeros(4)
        focal, middle = camera.K[0, 0].item(), camera.K[0, 2].item()
        u = focal * (ax * dx + bx * dy + cx * dz) / depth + middle
        v = -focal * (ay * dx + by * dy + cy * dz) / depth + middle
        # Pixel centres are whole, so the image spans from -1/2 to resolution - 1/2.
        x = 2.0 * (u + 0.5) / camera.resolution - 1.0
        y = 2.0 * (v + 0.5) / camera.resolution - 1.0
        seen = max(abs(x), abs(y)) <= 1.0 and (eye - centre) @ keypoint.normal > 0
        if not seen:
            return np.zeros(4)
        begin = eye + (centre - eye) * (self._near_m / depth)
        if self._is_occluded(physics, begin, centre, own=name == "eih"):
            return np.zeros(4)
        diameter = focal * keypoint.diameter_m / depth / camera.resolution
        return np.array([x, y, diameter, 1.0])

    def joint_positions(self, physics: mjcf.Physics) -> FloatArray:
        """True joint angles, (7,) rad."""
        return np.asarray(physics.data.ptr.qpos[self._qpos])

    def joint_velocities(self, physics: mjcf.Physics) -> FloatArray:
        """True joint speeds, (7,) rad/s."""
        return np.asarray(physics.data.ptr.qvel[self._qvel])

    def joint_torques(self, physics: mjcf.Physics) -> FloatArray:
        """Torques of the drives about the joints' axes, (7,) N m: they carry and move the arm.

        What the torque sensors of an iiwa show, which sit between gear and link: the weight, the
        motion and what the arm presses against, all together, within the published 176, 176, 110,
        110, 110, 40 and 40 N m. They are not the *external* torques that KUKA's controller derives
        from them by a model of the arm. Real sensors do not show what speeds the rotors up, which
        is in ours (0.1 kg m^2 times the acceleration: at most 1.4 N m at the published ones), and
        have noise, which ours have not.
        """
        # MuJoCo has them of before the last substep; the next substep computes them anew.
        mujoco.mj_fwdActuation(physics.model.ptr, physics.data.ptr)
        return np.asarray(physics.data.ptr.qfrc_actuator[self._qvel])

    def flange_position(self, physics: mjcf.Physics) -> FloatArray:
        """True position of the flange face's centre, (3,) m, base frame."""
        return physics.data.ptr.site_xpos[self._flange].copy()

    def measured_positions(self, physics: mjcf.Physics) -> FloatArray:
        """Joint angles as the encoders show them, (7,) rad."""
        return self.joint_positions(physics) + self.scenario.joint_offset

    def setpoint(self, physics: mjcf.Physics) -> FloatArray:
        """True joint set point that the controller tracks now, (7,) rad."""
        return np.asarray(physics.data.ptr.act[self._act])

    def setpoint_velocity(self) -> FloatArray:
        """Speed of the set point in the last control step, (7,) rad/s."""
        return self._speed.copy()

    def pending_setpoints(self) -> list[FloatArray]:
        """True set points that were commanded but do not act yet (latency), oldest first."""
        return [target - self.scenario.joint_offset for target in self._queue]

    def landing_mm(self, physics: mjcf.Physics) -> FloatArray:
        """Where the tip stands over the target, in the target plane.

        Returns:
            (2,) mm: along the base's x axis as the plane shows it, and across it (normal times
            that); its norm is ``lateral_error_mm``.
        """
        goal = self.goal()
        normal = goal.normal
        along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
        along /= np.linalg.norm(along)
        offset = 1000.0 * (self.tip(physics).position - goal.target)
        return np.array([offset @ along, offset @ np.cross(normal, along)])

    def commandable(self, q: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The ``joint_position`` action that sends the arm to true joint angles.

        Args:
            q: True joint angles, (7,) rad.

        Returns:
            (7,) float32, clipped to [-1, 1].
        """
        encoder = np.asarray(q, np.float64) + self.scenario.joint_offset
        return np.clip(encoder / JOINT_RANGE_RAD, -1.0, 1.0).astype(np.float32)

    def place(self, physics: mjcf.Physics, q: FloatArray) -> None:
        """Put the arm at rest at joint angles (7,) rad, for certificates and pictures."""
        data = physics.data.ptr
        data.qpos[self._qpos] = q
        data.qvel[self._qvel] = 0.0
        data.act[self._act] = q
        mujoco.mj_step1(physics.model.ptr, data)
        self._errors = self.family.measure(self.tip(physics)) | self.family.at_reset()

    def view(self, physics: mjcf.Physics, camera: str) -> int | mujoco.MjvCamera:
        """Camera for pictures: ``eih``, ``eth``, or ``cell`` for a third-person view."""
        del physics
        if camera in self.cameras:
            return self.cameras[camera].id
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FREE.value
        # Far enough for a stretched arm, whichever way it points.
        view.lookat[:] = [0.0, 0.0, 0.44]
        view.distance, view.azimuth, view.elevation = 2.6, 145.0, -22.0
        return view

    def _is_occluded(
        self, physics: mjcf.Physics, begin: FloatArray, centre: FloatArray, *, own: bool
    ) -> bool:
        ray = centre - begin
        hit = np.zeros(1, np.int32)
        # The eye-in-hand camera sits in the flange: its own link must not count.
        length = mujoco.mj_ray(
            physics.model.ptr,
            physics.data.ptr,
            begin,
            ray,
            self._rays,
            1,
            self._flange_body if own else -1,
            hit,
        )
        return bool(0.0 <= length < 1.0 - _RAY_SLACK_M / float(np.linalg.norm(ray)))

    def _clear_outcome(self) -> None:
        self._n_inside = 0
        self._n_clipped = 0
        self._inside_once = False
        self._success = False
        self._steps_to_goal = None
        self._collision = False
        self._truncated = False
        self._reward_terms = {}


def _accelerate(speed: FloatArray, distance: FloatArray, period_s: float) -> FloatArray:
    """Next set-point speed under acceleration limits, able to stop at the target.

    The largest v with v T + (braking distance from v in steps of a T) <= distance solves
    v^2 / (2 a) + v T / 2 = distance.

    Args:
        speed: Speed of the last control step, (7,) rad/s.
        distance: Way to the target, (7,) rad.
        period_s: Control period T (s).

    Returns:
        Speed, (7,) rad/s.
    """
    a, change = JOINT_ACCELERATION_RAD_S2, JOINT_ACCELERATION_RAD_S2 * period_s
    brake = a * period_s * (np.sqrt(0.25 + 2.0 * np.abs(distance) / (a * period_s**2)) - 0.5)
    wanted = np.sign(distance) * np.minimum(brake, np.abs(distance) / period_s)
    return np.clip(wanted, speed - change, speed + change)
