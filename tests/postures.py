"""Postures of the arm that tests need: at a goal, beside it, and a way there that hits nothing."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import kinematics, tool_frame, travel_time
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
_CLEARANCE_M = 0.015


def way(start: FloatArray, goal: FloatArray, n: int = 40) -> FloatArray:
    """Joints (n, 7) on the way there, each at its own full speed until it arrives."""
    distance = goal - start
    seconds = float((np.abs(distance) / JOINT_SPEED_RAD_S).max())
    reach = JOINT_SPEED_RAD_S * np.linspace(0.0, seconds, n)[:, None]
    return start + np.clip(distance, -reach, reach)


def goal_posture(env: "Environment") -> FloatArray:
    """The goal posture that the arm gets to soonest from its start without touching anything."""
    goal, start = env.goal(), env.scenario.start
    family = kinematics().goal_configurations_at_tool_angle(
        goal.position, goal.normal, float(start[6])
    )
    for q in family[np.argsort(travel_time(start, family, acceleration_limits=False))]:
        if _is_clear(env, way(start, q)):
            return np.asarray(q)
    raise AssertionError(f"no clear way in scenario {env.scenario.index}")


def _is_clear(env: "Environment", steps: FloatArray) -> bool:
    # The clearance query knows level surfaces only; on others MuJoCo's contacts have to do.
    level = env.task.root_entity.surface.shape == "flat"
    floor = 0.0 if level else -1.0
    if any(kinematics().clearance(q, floor) < _CLEARANCE_M for q in steps):
        return False
    data = mujoco.MjData(env.physics.model.ptr)
    for q in steps:
        data.qpos[:] = q
        mujoco.mj_kinematics(env.physics.model.ptr, data)
        mujoco.mj_collision(env.physics.model.ptr, data)
        if data.ncon:
            return False
    return True


def posture_at(x: float, y: float, standoff_m: float) -> FloatArray:
    """The posture nearest to upright with the flange over (x, y) of a flat surface, facing it."""
    position = np.array([x, y, standoff_m])
    family = kinematics().goal_configurations_at_tool_angle(position, UP, 0.0)
    return np.asarray(family[np.abs(family).sum(axis=1).argmin()])


def displaced(
    env: "Environment",
    *,
    lateral_m: float = 0.0,
    height_m: float = 0.0,
    tilt_deg: float = 0.0,
    yaw: float = 0.0,
) -> FloatArray:
    """A posture away from the goal pose by known errors.

    Args:
        env: A task at its start.
        lateral_m: Offset in the target plane (m).
        height_m: Offset along the normal (m).
        tilt_deg: Angle between the flange axis and the inward normal (deg).
        yaw: Turn about the flange axis (rad).
    """
    goal = env.goal()
    frame = tool_frame(goal.normal)
    raised = goal.position + goal.normal * height_m
    angle = np.deg2rad(tilt_deg)
    swivel = np.linspace(-np.pi, np.pi, 24)
    # At the rim of the working area only some directions stay within reach.
    for azimuth in 0.7 + np.arange(4) * np.pi / 2.0:
        across = np.cos(azimuth) * frame[:, 0] + np.sin(azimuth) * frame[:, 1]
        # Lean the tool axis about the other direction of the plane: it stays a unit vector.
        aside = np.cross(goal.normal, across)
        normal = np.cos(angle) * goal.normal + np.sin(angle) * aside
        family = kinematics().inverse_kinematics(
            raised + lateral_m * across, normal, np.full(len(swivel), yaw), swivel
        )
        if len(family):
            return np.asarray(family[0])
    raise AssertionError(f"scenario {env.scenario.index}: the displaced pose is out of reach")
