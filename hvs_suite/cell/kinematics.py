"""Kinematics and dynamics of the iiwa: Pinocchio on the cell's own MJCF, closed-form inverse.

All poses are in the robot's base frame (m, rad). The flange frame is the site ``flange``: origin
at the flange face centre, +z out along the tool axis. Positions of goals are the *tip*'s: the
tool's, which lies on that axis, or the flange itself where there is no tool.
"""

import functools
import pathlib
import tempfile
from collections.abc import Sequence

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from hvs_suite.cell import robot
from hvs_suite.embodiment import BARE_ARM, Embodiment
from hvs_suite.errors import OutputError

FloatArray = npt.NDArray[np.float64]

_UP = (0.0, 0.0, 1.0)
_SHOULDER = np.array([0.0, 0.0, robot.BASE_TO_SHOULDER_M])
_SINGULAR = 1e-9
"""Below this sine of A2 or A6 the two axes beside it coincide."""
_ITERATIONS = 8
_DRIFT_RANGE_RAD = np.radians(30.0)
_DRIFT_RAD = 0.05
_OFTEN_NEAREST = 4, 7
"""Links that come nearest to each other in most configurations: forearm and hand."""


def away_from_stops(q: FloatArray) -> FloatArray:
    """Joint angles (7,) in rad with those near their stops pushed back a little.

    The nearest configuration of a goal to these drifts, as far as the goal leaves joints free, from
    one control step to the next. A joint at its stop is pushed by `_DRIFT_RAD`, less the farther
    away it is, and not at all from `_DRIFT_RANGE_RAD` on.
    """
    near = 1.0 - (robot.JOINT_RANGE_RAD - np.abs(q)) / _DRIFT_RANGE_RAD
    return np.asarray(q - _DRIFT_RAD * np.sign(q) * np.clip(near, 0.0, 1.0))


def _wrap(angle: FloatArray) -> FloatArray:
    """The same angles within [-pi, pi) rad."""
    turned = angle + np.pi
    # NumPy's remainder takes ten times as long.
    turned -= np.floor(turned / (2.0 * np.pi)) * (2.0 * np.pi)
    return turned - np.pi


def _zyz_angles(R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angles a, b >= 0, c (n,) with R (n, 3, 3) = Rz(a) Ry(b) Rz(c); a = 0 where b is 0 or pi."""
    sin_b = np.hypot(R[:, 0, 2], R[:, 1, 2])
    a = np.where(sin_b < _SINGULAR, 0.0, np.arctan2(R[:, 1, 2], R[:, 0, 2]))
    b = np.arctan2(sin_b, R[:, 2, 2])
    # c from what Rz(a) leaves, so that a + c is right in the singular shape too.
    cos_a, sin_a = np.cos(a), np.sin(a)
    c = np.arctan2(cos_a * R[:, 1, 0] - sin_a * R[:, 0, 0], cos_a * R[:, 1, 1] - sin_a * R[:, 0, 1])
    return a, b, c


def _perpendicular(direction: FloatArray) -> FloatArray:
    """A unit vector (3,) at right angles to a unit vector (3,): the upward one where there is."""
    reference = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.999 else np.array([1.0, 0, 0])
    across = reference - direction * (reference @ direction)
    return np.asarray(across / np.linalg.norm(across))


def tool_frame(normal: npt.ArrayLike) -> FloatArray:
    """The flange orientation of yaw 0 that faces a surface.

    Args:
        normal: Outward surface normal (3,), base frame; need not have unit length.

    Returns:
        Rotation (3, 3) whose z axis is -normal and whose x axis points as much along the base
        frame's +x as it can (along +y where the normal is parallel to x). Yaw turns about z.
    """
    z = -np.asarray(normal, dtype=np.float64)
    z = z / np.linalg.norm(z)
    reference = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.999 else np.array([0.0, 1.0, 0.0])
    x = reference - z * (reference @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def travel_time(
    q_from: npt.ArrayLike, q_to: npt.ArrayLike, acceleration_limits: bool
) -> FloatArray:
    """Least time from rest to rest, the slowest joint deciding: a lower bound for any motion.

    Per joint over the distance d: d / v with speed limits alone; with acceleration limits
    d / v + v / a where top speed is reached (d >= v^2 / a), else 2 sqrt(d / a).

    Args:
        q_from: Start (7,) in rad.
        q_to: Ends (m, 7) in rad.
        acceleration_limits: Respect ``JOINT_ACCELERATION_RAD_S2`` too, not just the speeds.

    Returns:
        Times (m,) in s.
    """
    distance = np.abs(np.asarray(q_to, dtype=np.float64) - np.asarray(q_from, dtype=np.float64))
    v, a = robot.JOINT_SPEED_RAD_S, robot.JOINT_ACCELERATION_RAD_S2
    if not acceleration_limits:
        return np.asarray((distance / v).max(axis=-1))
    trapezoid = distance / v + v / a
    triangle = 2.0 * np.sqrt(distance / a)
    return np.asarray(np.where(distance >= v**2 / a, trapezoid, triangle).max(axis=-1))


class Kinematics:
    """Pinocchio's view of the cell's robot; configurations are (7,) in rad, A1 to A7.

    Not for use by several threads at once: Pinocchio's buffers are shared between calls.

    Raises:
        OutputError: There is no room for a temporary file.
    """

    def __init__(self, embodiment: Embodiment = BARE_ARM) -> None:
        self._wrist_to_tip_m = robot.WRIST_TO_FLANGE_M + embodiment.tool_length_m
        # Pinocchio reads MJCF from a file only.
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder, "iiwa7.xml")
                path.write_text(robot.robot_mjcf(embodiment), encoding="utf-8")
                self.model = pin.buildModelFromMJCF(str(path))
                self.geometry = pin.buildGeomFromMJCF(
                    self.model, str(path), pin.GeometryType.COLLISION
                )
        except OSError as error:
            raise OutputError(
                f"cannot write a temporary file of 10 kB: {error.strerror}; make room, or name "
                "another folder in TMPDIR"
            ) from error
        if self.model.nq != len(robot.JOINT_NAMES):
            raise RuntimeError("Pinocchio read no robot from the cell's MJCF")
        self._flange = self.model.getFrameId(robot.FLANGE)
        self._tip = self.model.getFrameId(robot.tip_name(embodiment))
        self._data = self.model.createData()
        self._scene = self._with_surface()
        self._scene_data = self._scene.createData()
        self._domed, self._measured = self._with_domes()
        self._domed_data = self._domed.createData()

    def _with_surface(self) -> pin.GeometryModel:
        """The robot over a surface; pairs up the geoms of links at least three joints apart.

        Nearer links keep a distance that their joint ranges guarantee (at least 34 mm, between the
        forearm's end and the flange), which would hide what the configuration decides.
        """
        self._surface: tuple[float, tuple[float, ...]] = 0.0, _UP
        self._half_space = coal.Halfspace(np.array(_UP), 0.0)
        scene = self.geometry.copy()
        surface = scene.addGeometryObject(
            pin.GeometryObject("surface", 0, pin.SE3.Identity(), self._half_space)
        )
        bodies = list(self.geometry.geometryObjects)
        for i, first in enumerate(bodies):
            for j in range(i + 1, len(bodies)):
                if abs(first.parentJoint - bodies[j].parentJoint) > 2:
                    scene.addCollisionPair(pin.CollisionPair(i, j))
            # Base and link 1 can never come closer to the surface than they stand.
            if first.parentJoint >= 2:
                scene.addCollisionPair(pin.CollisionPair(i, surface))
        return scene

    def _with_domes(self) -> tuple[pin.GeometryModel, list[bool]]:
        """The same scene, faster to measure, and which of its pairs hold the true bodies.

        Coal measures capsules by a formula and cylinders by iterating, which takes ten times as
        long. So cylinders of links get domes: a capsule holds its cylinder, hence is no farther
        from anything. Link 7 keeps its shape against link 4, which is nearest to it as a rule.
        """
        domed = self._scene.copy()
        domed.removeAllCollisionPairs()
        bodies = list(self._scene.geometryObjects)
        domes = list(range(len(bodies)))
        for i, body in enumerate(bodies):
            if isinstance(body.geometry, coal.Cylinder):
                dome = coal.Capsule(body.geometry.radius, 2.0 * body.geometry.halfLength)
                domes[i] = domed.addGeometryObject(
                    pin.GeometryObject(f"{body.name}_domed", body.parentJoint, body.placement, dome)
                )
        measured = []
        for pair in self._scene.collisionPairs:
            first, second = pair.first, pair.second
            links = bodies[first].parentJoint, bodies[second].parentJoint
            # The surface (0, as it stands on the ground) is measured by a formula as well.
            if links[1] != 0 and links != _OFTEN_NEAREST:
                first, second = domes[first], domes[second]
            domed.addCollisionPair(pin.CollisionPair(first, second))
            measured.append((first, second) == (pair.first, pair.second))
        return domed, measured

    def flange_pose(self, q: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and position (3,) in m of the flange in the base frame."""
        return self._pose(q, self._flange)

    def tip_pose(self, q: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and position (3,) in m of the tool's tip; the flange's without a tool."""
        return self._pose(q, self._tip)

    def _pose(self, q: npt.ArrayLike, frame: int) -> tuple[FloatArray, FloatArray]:
        pin.forwardKinematics(self.model, self._data, np.asarray(q, dtype=np.float64))
        placement = pin.updateFramePlacement(self.model, self._data, frame)
        return np.array(placement.rotation), np.array(placement.translation)

    def jacobian(self, q: npt.ArrayLike) -> FloatArray:
        """Jacobian (6, 7) of the tip: linear (m/rad) over angular rows, in base axes."""
        return np.asarray(
            pin.computeFrameJacobian(
                self.model,
                self._data,
                np.asarray(q, dtype=np.float64),
                self._tip,
                pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
            ).copy()
        )

    def mass_matrix(self, q: npt.ArrayLike) -> FloatArray:
        """Joint-space mass matrix (7, 7) in kg m^2, rotor inertia included."""
        M = pin.crba(self.model, self._data, np.asarray(q, dtype=np.float64))
        return np.asarray(np.triu(M) + np.triu(M, 1).T)

    def gravity_torques(self, q: npt.ArrayLike) -> FloatArray:
        """Torques (7,) in Nm that hold the arm still against gravity."""
        return np.asarray(
            pin.computeGeneralizedGravity(
                self.model, self._data, np.asarray(q, dtype=np.float64)
            ).copy()
        )

    def clearance(
        self,
        q: npt.ArrayLike,
        surface_height_m: float = 0.0,
        surface_normal: Sequence[float] | FloatArray = _UP,
    ) -> float:
        """Least distance (m) from links 2 to 7 to a plane surface, and between distant links.

        Uses the same collision geoms as MuJoCo; links less than three joints apart are not
        compared. Negative where bodies interpenetrate.

        Args:
            q: Configuration (7,) in rad.
            surface_height_m: Height of the surface over the base frame's origin (m).
            surface_normal: Its outward unit normal (3,), base frame.
        """
        surface = surface_height_m, tuple(surface_normal)
        if surface != self._surface:
            self._surface = surface
            normal = np.asarray(surface_normal, dtype=np.float64)
            self._half_space.n, self._half_space.d = normal, surface_height_m * normal[2]
        q = np.asarray(q, dtype=np.float64)
        nearest = pin.computeDistances(self.model, self._data, self._domed, self._domed_data, q)
        if self._measured[nearest]:
            return float(self._domed_data.distanceResults[nearest].min_distance)
        nearest = pin.computeDistances(self.model, self._data, self._scene, self._scene_data, q)
        return float(self._scene_data.distanceResults[nearest].min_distance)

    def inverse_kinematics(
        self,
        position: npt.ArrayLike,
        normal: npt.ArrayLike,
        yaw: npt.ArrayLike,
        swivel: npt.ArrayLike,
    ) -> FloatArray:
        """All configurations within the joint ranges that hold the flange at a pose.

        Closed form for the spherical shoulder, revolute elbow, spherical wrist: A4 follows from
        the distance of wrist and shoulder, the swivel picks the elbow on its circle about the
        line between them, and the roll-pitch-roll triples A1-A3 and A5-A7 are Euler angles. Each
        elbow place has eight shapes (mirrored at shoulder, elbow and wrist). All roll joints
        turn by less than a full circle, so no angle has a second value within its range.

        Args:
            position: Of the tip (3,) in m.
            normal: Outward surface normal (3,); the flange's +z is its opposite.
            yaw: Turn about the flange's +z from :func:`tool_frame` (n,) in rad, paired with
                ``swivel``.
            swivel: Angle of the elbow on its circle (n,) in rad, 0 at the highest point.

        Returns:
            Configurations (m, 7) in rad, m <= 8 n; none where the wrist is out of reach.
        """
        yaw, swivel = np.broadcast_arrays(
            np.atleast_1d(np.asarray(yaw, dtype=np.float64)),
            np.atleast_1d(np.asarray(swivel, dtype=np.float64)),
        )
        q = self.goal_shapes(position, normal, swivel)
        if len(q):
            q[:, 6] += np.tile(yaw, len(robot.MIRROR_SIGN))
        return _within_ranges(q)

    def goal_configurations(
        self,
        position: npt.ArrayLike,
        normal: npt.ArrayLike,
        n_yaw: int = 24,
        n_swivel: int = 24,
    ) -> FloatArray:
        """The redundant family of a goal: every yaw with every elbow place, in all shapes.

        Yaw turns A7 alone. For the fastest way alone, use
        :meth:`goal_configurations_at_tool_angle`, which needs no grid of yaws.

        Args:
            position: Of the tip (3,) in m.
            normal: Outward surface normal (3,).
            n_yaw: Evenly spaced yaws over the circle.
            n_swivel: Evenly spaced elbow places over the circle.

        Returns:
            Configurations (m, 7) in rad within the joint ranges, m <= 8 n_yaw n_swivel.
        """
        shapes = self.goal_shapes(position, normal, circle(n_swivel))
        shapes = shapes[(np.abs(shapes[:, :6]) <= robot.JOINT_RANGE_RAD[:6]).all(axis=1)]
        q = np.repeat(shapes, n_yaw, axis=0)
        q[:, 6] = _wrap(q[:, 6] + np.tile(circle(n_yaw), len(shapes)))
        return np.asarray(q[np.abs(q[:, 6]) <= robot.JOINT_RANGE_RAD[6]])

    def goal_configurations_at_tool_angle(
        self,
        position: npt.ArrayLike,
        normal: npt.ArrayLike,
        tool_angle: float,
        n_swivel: int = 72,
    ) -> FloatArray:
        """The family of a goal with A7 at a given angle: yaw is free, so A7 need not move at all.

        With ``tool_angle`` where A7 is now, this holds the fastest configurations of all yaws.

        Args:
            position: Of the tip (3,) in m.
            normal: Outward surface normal (3,).
            tool_angle: Angle of A7 (rad) within its range.
            n_swivel: Evenly spaced elbow places over the circle.

        Returns:
            Configurations (m, 7) in rad within the joint ranges, m <= 8 n_swivel.
        """
        q = self.goal_shapes(position, normal, circle(n_swivel))
        q[:, 6] = tool_angle
        return _within_ranges(q)

    def goal_shapes(
        self, position: npt.ArrayLike, normal: npt.ArrayLike, swivel: FloatArray
    ) -> FloatArray:
        """The family of a goal at yaw 0, row by row the same elbow places and shapes for any goal.

        Args:
            position: Of the tip (3,) in m.
            normal: Outward surface normal (3,).
            swivel: Angles of the elbow on its circle (n,) in rad, 0 at the highest point.

        Returns:
            (8 n, 7) in rad, joint ranges not checked, angles within [-pi, pi); shape by shape, each
            for all swivels in order; empty where the goal is out of reach.
        """
        R_goal = tool_frame(normal)
        wrist = np.asarray(position, dtype=np.float64) - self._wrist_to_tip_m * R_goal[:, 2]
        line = wrist - _SHOULDER
        reach = float(np.linalg.norm(line))
        upper, fore = robot.SHOULDER_TO_ELBOW_M, robot.ELBOW_TO_WRIST_M
        cos_elbow = (reach**2 - upper**2 - fore**2) / (2.0 * upper * fore)
        if abs(cos_elbow) > 1.0 + 1e-12 or reach == 0.0:
            return np.empty((0, 7))
        elbow = float(np.arccos(np.clip(cos_elbow, -1.0, 1.0)))
        sin_4, cos_4 = np.sin(elbow), np.cos(elbow)

        # Frame of the line shoulder-wrist after A3 (elbow on its +x side), and the same in base.
        along = np.array([-fore * sin_4, 0.0, upper + fore * cos_4]) / reach
        frame_arm = np.stack([[along[2], 0.0, -along[0]], [0.0, 1.0, 0.0], along], axis=1)
        axis = line / reach
        up = _perpendicular(axis)
        side = np.cross(axis, up)
        cos_s, sin_s = np.cos(swivel)[:, None], np.sin(swivel)[:, None]
        frame_base = np.empty((len(swivel), 3, 3))
        frame_base[:, :, 0] = cos_s * up + sin_s * side
        frame_base[:, :, 1] = cos_s * side - sin_s * up
        frame_base[:, :, 2] = axis
        R_shoulder = frame_base @ frame_arm.T
        R_elbow = np.array([[cos_4, 0.0, -sin_4], [0.0, 1.0, 0.0], [sin_4, 0.0, cos_4]])
        R_wrist = (R_shoulder @ R_elbow).transpose(0, 2, 1) @ R_goal

        q = np.empty((len(swivel), 7))
        q[:, 0], q[:, 1], q[:, 2] = _zyz_angles(R_shoulder)
        q[:, 3] = elbow
        q[:, 4], q[:, 5], q[:, 6] = _zyz_angles(R_wrist)
        shapes = robot.MIRROR_SIGN[:, None, :] * q + robot.MIRROR_SHIFT_RAD[:, None, :]
        return _wrap(shapes.reshape(-1, 7))

    def nearest_configuration(
        self, q: FloatArray, position: FloatArray, normal: FloatArray, weight: FloatArray
    ) -> FloatArray | None:
        """The configuration of a goal that is nearest to joint angles, by Gauss-Newton.

        Args:
            q: Joint angles (7,) in rad, not far from the goal.
            position: Of the tip (3,) in m.
            normal: Outward surface normal (3,); yaw about it is free.
            weight: How readily each joint turns (7,): distances are measured in q / weight.

        Returns:
            (7,) in rad, or None where the iteration ends outside the joint ranges or nowhere.
        """
        across = _across(normal.tobytes())
        for _ in range(_ITERATIONS):
            R, tip = self.tip_pose(q)
            # Rotation vector that takes the flange axis onto the inward normal.
            error = np.concatenate([position - tip, across @ _cross(R[:, 2], -normal)])
            if np.abs(error).max() < 1e-9:
                break
            jacobian = self.jacobian(q)
            weighted = np.concatenate([jacobian[:3], across @ jacobian[3:]]) * weight
            q = q + weight * _least_solution(weighted, error)
        else:
            return None
        if (np.abs(q) > robot.JOINT_RANGE_RAD).any() or R[:, 2] @ normal > 0.0:
            return None
        return np.asarray(q)


@functools.lru_cache(maxsize=256)
def _across(normal: bytes) -> FloatArray:
    """Two directions (2, 3) along a surface, from the bytes of its normal (3,)."""
    return np.asarray(np.linalg.svd(np.frombuffer(normal)[None])[2][1:])


def _least_solution(A: FloatArray, b: FloatArray) -> FloatArray:
    """The least x with A x = b as near as can be, leaving out directions that hardly count."""
    u, s, vt = np.linalg.svd(A, full_matrices=False)
    # ``np.linalg.pinv`` spends more on its checks than on its work.
    return np.asarray(np.where(s > 1e-3 * s[0], (b @ u) / s, 0.0) @ vt)


def _cross(one: FloatArray, two: FloatArray) -> FloatArray:
    """Vector product (3,) of two vectors (3,); NumPy's is slow on so few numbers."""
    (a, b, c), (x, y, z) = one.tolist(), two.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def circle(n: int) -> FloatArray:
    """Angles (n,) in rad, evenly spaced over the full circle from 0."""
    return np.arange(n, dtype=np.float64) * (2.0 * np.pi / n)


def _within_ranges(q: FloatArray) -> FloatArray:
    """The rows of q (n, 7), wrapped to [-pi, pi), that lie within the joint ranges."""
    q = _wrap(q)
    return q[(np.abs(q) <= robot.JOINT_RANGE_RAD).all(axis=1)]


def kinematics(embodiment: Embodiment = BARE_ARM) -> Kinematics:
    """The process's one :class:`Kinematics` of an embodiment, built at first use."""
    return _kinematics(embodiment)


_kinematics = functools.cache(Kinematics)
