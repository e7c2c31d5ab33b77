"""The tool as part of the robot's MJCF: adapter, collet, peg, camera bracket and their shells.

The tool's body is welded to link 7. Its site ``tip`` is what goals are measured at, and a force and
a torque sensor at the flange face feel what the tool feels.
"""

import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import mjcf

from hvs_suite.embodiment import (
    ADAPTER_LENGTH_M,
    COLLET_LENGTH_M,
    COLLET_RADIUS_M,
    Embodiment,
    Tool,
)

FloatArray = npt.NDArray[np.float64]

BODY = "tool"
PEG_GEOMS = ("peg", "peg_edge")
"""What may meet a hole."""
TIP = "tip"
WRENCH = "wrench"
"""Name of the sensed site; the sensors are called ``wrench_force`` and ``wrench_torque``."""
CONTACT: dict[str, Any] = {
    # Twice a timestep of 1/400 s: MuJoCo would lengthen a shorter time constant at a longer step,
    # and so compare another contact at another step.
    "solref": (0.005, 1.0),
    "solimp": (0.95, 0.99, 0.0005, 0.5, 2.0),
    "friction": (0.15, 0.0001, 0.00001),
    "condim": 3,
}
"""Contact between peg and bushing: stiff, steel on oiled steel. Deepest penetration 0.02 mm."""
_STEEL_KG_M3 = 7850.0
_ALUMINIUM_KG_M3 = 2700.0
_ADAPTER_RADIUS_M = 0.0315
_HOUSING_HALF_M = (0.010, 0.010, 0.012)
_EDGES = 48


def add_tool(root: mjcf.RootElement, link: Any, embodiment: Embodiment, flange_pos: Any) -> None:
    """Adds the tool's body to the robot's tree: inertia, collision geoms, sites and sensors.

    Args:
        root: The robot's tree.
        link: Body that carries the flange.
        embodiment: Says what the tool is.
        flange_pos: Flange face centre in the link's frame (m).
    """
    tool = embodiment.tool
    assert tool is not None
    body = link.add("body", name=BODY, pos=flange_pos, gravcomp=1)
    mass, centre, inertia = _mass_properties(tool)
    body.add("inertial", mass=mass, pos=(0, 0, centre), diaginertia=inertia)
    for number, (kind, keywords) in enumerate(_holder(embodiment)):
        body.add(
            "geom", name=f"{BODY}_collision_{number}", type=kind, dclass="collision", **keywords
        )
    start, end = ADAPTER_LENGTH_M + COLLET_LENGTH_M, tool.length_m
    radius, edge = 0.5 * tool.peg_diameter_m, tool.edge_m
    peg = {"dclass": "collision", "priority": 1, **CONTACT}
    body.add(
        "geom",
        name=PEG_GEOMS[0],
        type="cylinder",
        fromto=(0, 0, start, 0, 0, end - 2.0 * edge),
        size=[radius],
        **peg,
    )
    root.asset.add(
        "mesh",
        name="peg_edge",
        vertex=np.round(_frustum(radius, radius - edge, end - 2.0 * edge, end), 8).ravel(),
    )
    body.add("geom", name=PEG_GEOMS[1], type="mesh", mesh="peg_edge", **peg)
    body.add("site", name=TIP, pos=(0, 0, tool.length_m), group=4)
    body.add("site", name=WRENCH, group=4)
    root.sensor.add("force", name=f"{WRENCH}_force", site=WRENCH)
    root.sensor.add("torque", name=f"{WRENCH}_torque", site=WRENCH)
    for other in ("link_5", "link_6", "link_7"):
        root.contact.add("exclude", body1=other, body2=BODY)


def add_tool_shells(root: mjcf.RootElement, embodiment: Embodiment, group: int) -> None:
    """Adds what the tool looks like; without contacts and mass."""
    tool = embodiment.tool
    assert tool is not None
    body = root.find("body", BODY)
    common: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": group}
    root.asset.add(
        "material", name="tool_steel", rgba=(0.55, 0.57, 0.60, 1), specular=0.6, shininess=0.6
    )
    root.asset.add("material", name="tool_dark", rgba=(0.16, 0.16, 0.18, 1))
    for number, (kind, keywords) in enumerate(_holder(embodiment)):
        body.add(
            "geom",
            name=f"{BODY}_shell_{number}",
            type=kind,
            material="tool_steel" if number == 1 else "tool_dark",
            **keywords,
            **common,
        )
    profile = _peg_profile(tool)
    mesh = trimesh.creation.revolve(profile, sections=_EDGES)
    root.asset.add(
        "mesh",
        name="peg_shell",
        vertex=np.round(mesh.vertices, 7).ravel(),
        face=mesh.faces.ravel(),
        inertia="shell",
    )
    body.add(
        "geom", name="peg_shell", type="mesh", mesh="peg_shell", material="tool_steel", **common
    )
    axes, eye = embodiment.hand_eye
    # The housing ends a millimetre behind the lens, so that it never shows.
    body.add(
        "geom",
        name="lens_shell",
        type="cylinder",
        material="tool_steel",
        size=[0.006, 0.002],
        pos=eye - 0.004 * axes[:, 2],
        quat=_quat(axes),
        **common,
    )


class Wrench:
    """What the tool feels at the flange: force and torque on it, its own weight taken out.

    Args:
        physics: The compiled cell.
        robot: MJCF of the robot within it.
    """

    def __init__(self, physics: mjcf.Physics, robot: mjcf.RootElement) -> None:
        model = physics.model
        names = (f"{WRENCH}_force", f"{WRENCH}_torque")
        sensors = [physics.bind(robot.find("sensor", name)).element_id for name in names]
        self._addresses = [int(model.sensor_adr[sensor]) for sensor in sensors]
        body = int(physics.bind(robot.find("body", BODY)).element_id)
        self._site = int(physics.bind(robot.find("site", WRENCH)).element_id)
        self._weight = float(model.body_mass[body]) * np.array(model.opt.gravity)
        self._centre = model.body_ipos[body].tolist()

    def read(self, physics: mjcf.Physics) -> FloatArray:
        """Force (N) and torque about the flange face's centre (Nm), flange axes, (6,).

        Of the last physics step; zeros at the reset, where the arm stands still and touches
        nothing.
        """
        data = physics.data.ptr
        if data.time == 0.0:
            return np.zeros(6)
        # The sensors say how the arm holds the tool: against its weight and what it touches.
        force, torque = (-data.sensordata[at : at + 3] for at in self._addresses)
        weight = data.site_xmat[self._site].reshape(3, 3).T @ self._weight
        # Plain floats: NumPy takes ten times as long for a cross product.
        (x, y, z), (wx, wy, wz) = self._centre, weight.tolist()
        moment = [y * wz - z * wy, z * wx - x * wz, x * wy - y * wx]
        return np.concatenate([force - weight, torque - moment])


def _holder(embodiment: Embodiment) -> list[tuple[str, dict[str, Any]]]:
    """Geoms of adapter, collet, and the camera's bracket and housing."""
    axes, eye = embodiment.hand_eye
    top, middle = ADAPTER_LENGTH_M, ADAPTER_LENGTH_M + COLLET_LENGTH_M
    housing = eye - (_HOUSING_HALF_M[2] + 0.005) * axes[:, 2]
    half_arm = 0.5 * abs(eye[1])
    return [
        ("cylinder", {"fromto": (0, 0, 0, 0, 0, top), "size": [_ADAPTER_RADIUS_M]}),
        ("cylinder", {"fromto": (0, 0, top, 0, 0, middle), "size": [COLLET_RADIUS_M]}),
        ("box", {"pos": housing, "quat": _quat(axes), "size": _HOUSING_HALF_M}),
        ("box", {"pos": (0, -half_arm, 0.003), "size": (0.008, half_arm, 0.003)}),
    ]


def _peg_profile(tool: Tool) -> FloatArray:
    """Radius and height (n, 2) m of the peg's outline, from its root to its tip."""
    radius, end = 0.5 * tool.peg_diameter_m, tool.length_m
    return np.array(
        [
            (0.0, ADAPTER_LENGTH_M),
            (radius, ADAPTER_LENGTH_M),
            (radius, end - 2.0 * tool.edge_m),
            (radius - tool.edge_m, end),
            (0.0, end),
        ]
    )


def _frustum(lower: float, upper: float, start: float, end: float) -> FloatArray:
    """Corners (n, 3) m of a cone's slice along z."""
    turns = np.arange(_EDGES) * (2.0 * math.pi / _EDGES)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.concatenate(
        [
            np.column_stack([radius * ring, np.full(_EDGES, z)])
            for radius, z in ((lower, start), (upper, end))
        ]
    )


def _mass_properties(tool: Tool) -> tuple[float, float, tuple[float, float, float]]:
    """Mass (kg), height of the centre of mass (m), inertia about it (kg m^2) of the cylinders."""
    parts = (
        (_ADAPTER_RADIUS_M, 0.0, ADAPTER_LENGTH_M, _ALUMINIUM_KG_M3),
        (COLLET_RADIUS_M, ADAPTER_LENGTH_M, COLLET_LENGTH_M, _STEEL_KG_M3),
        (
            0.5 * tool.peg_diameter_m,
            ADAPTER_LENGTH_M + COLLET_LENGTH_M,
            tool.peg_length_m,
            _STEEL_KG_M3,
        ),
    )
    masses = [math.pi * r**2 * length * density for r, _, length, density in parts]
    middles = [start + 0.5 * length for _, start, length, _ in parts]
    mass = sum(masses)
    centre = sum(m * z for m, z in zip(masses, middles, strict=True)) / mass
    across = sum(
        m * ((3.0 * r**2 + length**2) / 12.0 + (z - centre) ** 2)
        for m, z, (r, _, length, _) in zip(masses, middles, parts, strict=True)
    )
    about = sum(0.5 * m * r**2 for m, (r, *_) in zip(masses, parts, strict=True))
    return round(mass, 6), round(centre, 6), (round(across, 9), round(across, 9), round(about, 9))


def _quat(axes: FloatArray) -> FloatArray:
    """Quaternion (4,) w x y z of a rotation (3, 3)."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    return quat
