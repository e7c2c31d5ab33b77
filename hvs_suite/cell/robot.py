"""The KUKA LBR iiwa 7 R800: chain, inertia, joint control, collision bodies.

One description serves MuJoCo and Pinocchio: :func:`robot_mjcf` is the bare text that both load, and
`hvs_suite.cell.arm.Iiwa7` is the same tree with visual shells. Frames: the base frame stands on the
mounting plane with z up; at the zero pose every link frame is parallel to it.

Contact bits (two geoms meet if the contype of one shares a bit with the conaffinity of the other;
links less than three apart, counting the base, never meet and are excluded):

=================  ====================  ==========================
geom               contype               conaffinity
=================  ====================  ==========================
links 1 to 7       ``ROBOT_BIT``         ``ROBOT_BIT | SCENE_BIT``
base               ``ROBOT_BIT``         ``ROBOT_BIT``
surfaces, objects  ``SCENE_BIT``         0
=================  ====================  ==========================
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from dm_control import mjcf

from hvs_suite.cell.tool import TIP, add_tool
from hvs_suite.embodiment import BARE_ARM, Embodiment

FloatArray = npt.NDArray[np.float64]

JOINT_NAMES: tuple[str, ...] = ("A1", "A2", "A3", "A4", "A5", "A6", "A7")
JOINT_RANGE_RAD: FloatArray = np.radians([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
"""Half the range of each joint, symmetric about zero (rad)."""
JOINT_SPEED_RAD_S: FloatArray = np.radians([98.0, 98.0, 100.0, 130.0, 140.0, 180.0, 180.0])
JOINT_TORQUE_NM: FloatArray = np.array([176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0])
JOINT_ACCELERATION_RAD_S2: FloatArray = np.array([8.65, 5.44, 5.69, 11.01, 11.78, 13.76, 13.17])
"""Estimates published by others; KUKA gives none."""
JOINT_AXES: tuple[tuple[int, int, int], ...] = (
    (0, 0, 1),
    (0, 1, 0),
    (0, 0, 1),
    (0, -1, 0),
    (0, 0, 1),
    (0, 1, 0),
    (0, 0, 1),
)

BASE_TO_SHOULDER_M = 0.340
SHOULDER_TO_ELBOW_M = 0.400
ELBOW_TO_WRIST_M = 0.400
WRIST_TO_FLANGE_M = 0.126
FLANGE_RADIUS_M = 0.0315
"""ISO 9409-1-50-7-M6: outer diameter 63 mm."""

JOINT_HEIGHTS_M: tuple[float, ...] = (0.150, 0.340, 0.550, 0.740, 0.950, 1.140, 1.221)
"""Height of each link frame above the base at the zero pose; A2, A4, A6 are pivot centres."""
FLANGE_HEIGHT_M = BASE_TO_SHOULDER_M + SHOULDER_TO_ELBOW_M + ELBOW_TO_WRIST_M + WRIST_TO_FLANGE_M

# A shape and its mirror image through each of the three pivots: adding pi to the two roll joints
# beside a pivot and negating the pivot leaves the pose of everything else alone.
_FLIP_SHOULDER = np.array([1, 0, 1, 0, 0, 0, 0], dtype=np.float64)
_FLIP_ELBOW = np.array([0, 0, 1, 0, 1, 0, 0], dtype=np.float64)
_FLIP_WRIST = np.array([0, 0, 0, 0, 1, 0, 1], dtype=np.float64)


def _mirrors() -> tuple[FloatArray, FloatArray]:
    """Shift (8, 7) in rad and sign (8, 7) that turn one shape into its eight mirror shapes."""
    shifts, signs = [], []
    for shoulder in (0, 1):
        for elbow in (0, 1):
            for wrist in (0, 1):
                flips = shoulder * _FLIP_SHOULDER + elbow * _FLIP_ELBOW + wrist * _FLIP_WRIST
                shifts.append(np.pi * flips)
                signs.append([1, 1 - 2 * shoulder, 1, 1 - 2 * elbow, 1, 1 - 2 * wrist, 1])
    return np.array(shifts), np.array(signs, dtype=np.float64)


MIRROR_SHIFT_RAD, MIRROR_SIGN = _mirrors()
"""What makes the eight mirror shapes of one: its angles times the sign, plus the shift, (8, 7)."""

PHYSICS_TIMESTEP_S = BARE_ARM.timestep_s
"""The timestep that the gains below are tuned for, with integrator ``implicitfast``."""
ARMATURE_KG_M2 = 0.1
"""Rotor inertia seen through the gears; KUKA gives none."""
# Tuned together over moves to ring goals from the upright pose, at full speed and under the
# published accelerations, and for small steps: the tip must stand within 0.02 mm two control steps
# after the set point arrives and pass the goal by less than 0.1 mm, torque limits included.
STIFFNESS_NM_RAD: FloatArray = np.array([21e3, 41e3, 9.9e3, 10.3e3, 520.0, 520.0, 475.0])
"""Position gain of each joint; gravity is compensated, so it carries no standing load."""
DAMPING_NM_S_RAD: FloatArray = np.array([670.0, 1300.0, 298.0, 286.0, 17.2, 17.2, 15.6])
"""Velocity gain of each joint, on the joint's own speed: a moving set point leads by kv / kp."""
LAG_S: FloatArray = DAMPING_NM_S_RAD / STIFFNESS_NM_RAD
"""Each joint trails a moving set point by kv / kp (s)."""

FLANGE = "flange"
ROBOT_BIT = 1
SCENE_BIT = 2
SHELL_GROUP = 2
"""Visual geoms, shown by default, never in contact."""
COLLISION_GROUP = 3
"""Collision geoms, hidden by default."""


@dataclasses.dataclass(frozen=True)
class _Capsule:
    """A collision geom between two points of the link frame (m), with round or flat ends."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    kind: Literal["capsule", "cylinder"] = "capsule"


@dataclasses.dataclass(frozen=True)
class _Link:
    """A link's inertia and collision geoms, in its own frame.

    Attributes:
        mass: Published mass (kg); the base and links add up to the data sheet's 23.9 kg.
        centre: Centre of mass (m).
        inertia: Inertia about it (kg m^2): xx, yy, zz, xy, xz, yz.
        capsules: Collision geoms; they follow the shells to about 2 cm at the joints, better
            elsewhere.
    """

    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]
    capsules: tuple[_Capsule, ...]


# Centres of mass and inertias are not published. These are those of the shells as solids of uniform
# density, scaled to the published mass (shells.solid_inertia; a test compares the two).
_LINKS: tuple[_Link, ...] = (
    _Link(
        4.856,
        (-0.0223, 0, 0.0605),
        (0.01599, 0.02296, 0.0233, 0, -0.00104, 0),
        (
            _Capsule((0, 0, 0.060), (0, 0, 0.068), 0.078),
            _Capsule((-0.089, -0.020, 0.052), (-0.089, 0.020, 0.052), 0.048),
        ),
    ),
    _Link(
        3.394,
        (0, -0.0221, 0.1158),
        (0.02075, 0.02092, 0.00869, 0, 0, 0.00389),
        (
            _Capsule((0, 0, 0.060), (0, -0.016, 0.120), 0.074),
            _Capsule((0, -0.045, 0.190), (0, -0.025, 0.190), 0.074),
        ),
    ),
    _Link(
        4.032,
        (0, 0.0207, 0.0829),
        (0.02731, 0.0277, 0.00954, 0, 0, 0.00474),
        (
            _Capsule((0, 0.025, 0), (0, 0.042, 0), 0.074),
            _Capsule((0, 0.022, 0.060), (0, 0, 0.150), 0.070),
        ),
    ),
    _Link(
        3.394,
        (0, 0.0210, 0.1150),
        (0.01988, 0.01995, 0.00785, 0, 0, -0.0037),
        (
            _Capsule((0, 0, 0.060), (0, 0.016, 0.120), 0.070),
            _Capsule((0, 0.025, 0.190), (0, 0.042, 0.190), 0.070),
        ),
    ),
    _Link(
        4.032,
        (0, -0.0197, 0.0823),
        (0.02609, 0.02648, 0.00819, 0, 0, -0.0044),
        (
            _Capsule((0, -0.025, 0), (0, -0.038, 0), 0.070),
            _Capsule((0, -0.020, 0.060), (0, 0, 0.150), 0.065),
        ),
    ),
    _Link(
        1.529,
        (0, -0.0182, 0.0771),
        (0.00573, 0.00511, 0.00282, 0, 0, 0.00168),
        (
            _Capsule((0, 0, 0.050), (0, -0.010, 0.065), 0.060),
            # The slim arm beside the wrist, past which link 7 swings.
            _Capsule((0, -0.084, 0.140), (0, -0.054, 0.140), 0.047, "cylinder"),
            _Capsule((0, -0.084, 0.190), (0, -0.054, 0.190), 0.047, "cylinder"),
        ),
    ),
    _Link(
        2.404,
        (0, 0.0079, 0.0077),
        (0.00429, 0.00301, 0.00414, 0, 0, 0.00015),
        (
            _Capsule((0, -0.002, 0), (0, 0.034, 0), 0.052),
            _Capsule((0, 0, 0), (0, 0, 0.010), 0.048),
        ),
    ),
    _Link(
        0.259,
        (0, 0, 0.0102),
        (0.00019, 0.00019, 0.00023, 0, 0, 0),
        # Flat ends: a capsule's dome would stand out in front of the flange face.
        (
            _Capsule((0, 0, -0.018), (0, 0, 0.028), 0.045, "cylinder"),
            _Capsule((0, 0, 0.028), (0, 0, 0.045), FLANGE_RADIUS_M, "cylinder"),
        ),
    ),
)
"""The base and links 1 to 7."""


def set_point_after(set_point: FloatArray, command: FloatArray, period_s: float) -> FloatArray:
    """Where the joint set point is a control step after a command: as near as the joints may go.

    Args:
        set_point: Before, (..., 7) rad.
        command: Joint positions asked for, (..., 7) rad.
        period_s: Length of the control step (s).

    Returns:
        (..., 7) rad.
    """
    longest = JOINT_SPEED_RAD_S * period_s
    return np.asarray(set_point + np.clip(command - set_point, -longest, longest))


def after_commands(
    joints: FloatArray,
    velocities: FloatArray,
    set_point: FloatArray,
    commands: Iterable[FloatArray],
    period_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where the arm is once commands that are under way have been carried out.

    With time constant tau = kv / kp, a joint q that trails a set point on a ramp from s0 to s1 over
    T ends at s1 - tau r + (q - s0 + tau r) exp(-T / tau), where r = (s1 - s0) / T.

    Args:
        joints: Now, (7,) rad.
        velocities: Now, (7,) rad/s.
        set_point: Now, (7,) rad.
        commands: Joint positions asked for, (7,) rad each, one a control step.
        period_s: Length of the control step (s).

    Returns:
        Joint positions (rad) and velocities (rad/s), and the set point (rad), (7,) each.
    """
    decay = np.exp(-period_s / LAG_S)
    for command in commands:
        arrived = set_point_after(set_point, command, period_s)
        trail = LAG_S * (arrived - set_point) / period_s
        joints = arrived - trail + (joints - set_point + trail) * decay
        velocities = (arrived - joints) / LAG_S
        set_point = arrived
    return np.asarray(joints), np.asarray(velocities), set_point


def set_point_to_reach(
    goal: FloatArray, joints: FloatArray, set_point: FloatArray, period_s: float
) -> FloatArray:
    """The set point at the end of a control step that has the joints at a goal by then.

    `after_commands` solved for the set point: with time constant tau = kv / kp, d = exp(-T / tau)
    and c = tau / T, s1 = (goal - (c - d - c d) s0 - d q) / (1 - c + c d).

    Args:
        goal: Where the joints shall be, (7,) rad.
        joints: Now, (7,) rad.
        set_point: Now, (7,) rad.
        period_s: Length of the control step T (s).

    Returns:
        (7,) rad; may be farther than the joints can go in a control step.
    """
    decay, share = np.exp(-period_s / LAG_S), LAG_S / period_s
    ahead = goal - (share - decay - share * decay) * set_point - decay * joints
    return np.asarray(ahead / (1.0 - share + share * decay))


def _add_capsules(body: Any, name: str, capsules: tuple[_Capsule, ...], conaffinity: int) -> None:
    """Adds the collision capsules of one link to its body."""
    for i, capsule in enumerate(capsules):
        body.add(
            "geom",
            name=f"{name}_collision_{i}",
            type=capsule.kind,
            fromto=(*capsule.start, *capsule.end),
            size=[capsule.radius],
            dclass="collision",
            conaffinity=conaffinity,
        )


def _add_inertial(body: Any, link: _Link) -> None:
    body.add("inertial", mass=link.mass, pos=link.centre, fullinertia=link.inertia)


def robot_tree(embodiment: Embodiment = BARE_ARM) -> mjcf.RootElement:
    """Builds the bare robot: bodies, joints, actuators, collision geoms, flange site and tool."""
    root = mjcf.RootElement(model="iiwa7")
    root.compiler.angle = "radian"
    root.compiler.autolimits = True
    root.option.timestep = embodiment.timestep_s
    root.option.integrator = "implicitfast"
    collision = root.default.add("default", dclass="collision").geom
    collision.contype = ROBOT_BIT
    collision.conaffinity = ROBOT_BIT | SCENE_BIT
    collision.group = COLLISION_GROUP
    collision.mass = 0
    collision.rgba = (0.8, 0.2, 0.2, 0.5)

    body = root.worldbody.add("body", name="base")
    _add_inertial(body, _LINKS[0])
    _add_capsules(body, "base", _LINKS[0].capsules, conaffinity=ROBOT_BIT)
    height = 0.0
    for i, joint_name in enumerate(JOINT_NAMES):
        name = f"link_{i + 1}"
        link = _LINKS[i + 1]
        body = body.add(
            "body", name=name, pos=(0, 0, round(JOINT_HEIGHTS_M[i] - height, 6)), gravcomp=1
        )
        height = JOINT_HEIGHTS_M[i]
        _add_inertial(body, link)
        torque = JOINT_TORQUE_NM[i]
        body.add(
            "joint",
            name=joint_name,
            type="hinge",
            axis=JOINT_AXES[i],
            range=(-JOINT_RANGE_RAD[i], JOINT_RANGE_RAD[i]),
            armature=ARMATURE_KG_M2,
            actuatorgravcomp=True,
            actuatorfrcrange=(-torque, torque),
        )
        _add_capsules(body, name, link.capsules, conaffinity=ROBOT_BIT | SCENE_BIT)
        root.actuator.add(
            "intvelocity",
            name=joint_name,
            joint=joint_name,
            kp=STIFFNESS_NM_RAD[i] * embodiment.stiffness,
            kv=DAMPING_NM_S_RAD[i] * math.sqrt(embodiment.stiffness),
            # The joint's limit alone would do for the physics, but implicitfast leaves out the
            # damping of a saturated drive only where the actuator itself is limited.
            forcerange=(-torque, torque),
            ctrlrange=(-JOINT_SPEED_RAD_S[i], JOINT_SPEED_RAD_S[i]),
            actrange=(-JOINT_RANGE_RAD[i], JOINT_RANGE_RAD[i]),
        )
        # MuJoCo filters parent and child only where the parent can move. Links two apart cannot
        # meet within the joint ranges (a test proves it); not looking saves time in every substep.
        links = ["base"] + [f"link_{j + 1}" for j in range(i + 1)]
        for other in links[-3:-1]:
            root.contact.add("exclude", body1=other, body2=name)
    face = (0, 0, round(FLANGE_HEIGHT_M - height, 6))
    body.add("site", name=FLANGE, pos=face, group=4)
    if embodiment.tool is not None:
        add_tool(root, body, embodiment, face)
    return root


def tip_name(embodiment: Embodiment) -> str:
    """Name of the site at the tool's tip, which is the flange's where there is no tool."""
    return FLANGE if embodiment.tool is None else TIP


def robot_mjcf(embodiment: Embodiment = BARE_ARM) -> str:
    """The bare robot (no shells, no assets) as MJCF text that MuJoCo and Pinocchio both load."""
    return str(robot_tree(embodiment).to_xml_string())
