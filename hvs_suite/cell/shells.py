"""Visual shells of the iiwa, made by code: light, smooth and without contact.

An iiwa link is a bent tube: one end turns on a roll axis (along the arm), the other on a pitch axis
(across it), and the tube leans to one side so that the next link can start on the other. That gives
the arm its S shape. Each tube is a loft through closed oval rings; a ring is named by the two
points where it crosses the plane x = 0 and by its half width along x. Pitch housings of links 2, 4
and 6 are orange, the rest is light grey with dark joint gaps.

Everything is in the frame of its link (m), which is parallel to the base frame at the zero pose.
"""

import dataclasses
import functools
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import mjcf

from hvs_suite.cell import robot

FloatArray = npt.NDArray[np.float64]
Paint = Literal["grey", "orange", "dark", "metal"]
Ring = tuple[float, float, float, float, float]
"""(y, z) of the inner point, (y, z) of the outer point, half width along x."""

PAINT_RGBA: dict[Paint, tuple[float, float, float, float]] = {
    "grey": (0.72, 0.73, 0.74, 1.0),
    "orange": (0.95, 0.40, 0.05, 1.0),
    "dark": (0.16, 0.17, 0.18, 1.0),
    "metal": (0.62, 0.63, 0.65, 1.0),
}
_N_SIDES = 18
"""Corners of a ring: round at 336 px, and the whole robot stays below 4,000 triangles."""


@dataclasses.dataclass(frozen=True)
class Shell:
    """A closed surface of one colour, in the frame of its link."""

    body: str
    name: str
    paint: Paint
    mesh: trimesh.Trimesh


def _loft(rings: list[Ring], mirror: bool = False) -> trimesh.Trimesh:
    """A closed tube through oval rings, in the order along the tube, with flat ends.

    Args:
        rings: The rings; inner and outer points keep their sides along the tube.
        mirror: Mirror at the plane y = 0, for links that lean the other way.
    """
    table = np.array(rings)
    inner, outer, width = table[:, None, 0:2], table[:, None, 2:4], table[:, 4:5]
    angle = np.arange(_N_SIDES) * (2.0 * np.pi / _N_SIDES)
    centre, half = (inner + outer) / 2.0, (outer - inner) / 2.0
    in_plane = centre + half * np.cos(angle)[:, None]
    vertices = np.concatenate([(width * np.sin(angle))[..., None], in_plane], axis=2)
    if mirror:
        vertices[..., 1] *= -1.0
    n_rings = len(rings)
    index = np.arange(n_rings * _N_SIDES).reshape(n_rings, _N_SIDES)
    low, high = index[:-1], index[1:]
    low_next, high_next = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    sides = np.concatenate(
        [
            np.stack([low, low_next, high], axis=-1).reshape(-1, 3),
            np.stack([low_next, high_next, high], axis=-1).reshape(-1, 3),
        ]
    )
    # Ends have corners of their own, so that their edge stays sharp.
    ends = np.concatenate([vertices[0], vertices[-1]])
    first = n_rings * _N_SIDES
    fan = np.arange(1, _N_SIDES - 1)
    zero = np.zeros_like(fan)
    bottom = np.stack([zero, fan + 1, fan], axis=-1) + first
    top = np.stack([zero, fan, fan + 1], axis=-1) + first + _N_SIDES
    mesh = trimesh.Trimesh(
        vertices=np.concatenate([vertices.reshape(-1, 3), ends]),
        faces=np.concatenate([sides, bottom, top]),
        process=False,
    )
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _turned(
    profile: list[tuple[float, float]],
    axis: Literal["y", "z"] = "z",
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> trimesh.Trimesh:
    """A solid of revolution.

    Args:
        profile: (radius, height along the axis) in m, from one pole to the other.
        axis: Axis of revolution.
        centre: Origin of the axis.
    """
    mesh = trimesh.creation.revolve(np.array(profile), sections=_N_SIDES)
    if axis == "y":
        turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        mesh.apply_transform(turn)
    mesh.apply_translation(centre)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _gap(
    radius: float,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    axis: Literal["y", "z"] = "z",
) -> trimesh.Trimesh:
    """The dark band that shows between two links that turn against each other."""
    return _turned([(radius, -0.007), (radius, 0.007)], axis, centre)


def _cap(offset: float, height: float, radius: float, negative: bool) -> trimesh.Trimesh:
    """The round cover on the outside of a pitch housing, standing out by 4 mm.

    Args:
        offset: Distance of the housing's wall from the plane y = 0 (m).
        height: Height of the pitch axis (m).
        radius: Radius of the cover (m).
        negative: The wall is at -y.
    """
    profile = [(radius, -0.012), (radius, 0.002), (radius - 0.004, 0.005), (0, 0.005)]
    if negative:
        profile = [(r, -z) for r, z in profile]
    return _turned(profile, "y", (0, -offset if negative else offset, height))


def _base() -> list[Shell]:
    foot = _turned(
        [
            (0, 0),
            (0.100, 0),
            (0.104, 0.006),
            (0.104, 0.020),
            (0.098, 0.028),
            (0.086, 0.034),
            (0.080, 0.050),
            (0.078, 0.080),
            (0.076, 0.130),
            (0.073, 0.145),
            (0, 0.145),
        ]
    )
    # Connectors leave at the back, behind a rounded box.
    corners = [
        (x, y, z) for x in (-0.135, -0.05) for y in (-0.052, 0.052) for z in (0.004, 0.086)
    ] + [(x, y, 0.104) for x in (-0.118, -0.05) for y in (-0.040, 0.040)]
    corners += [(-0.128, y, z) for y in (-0.062, 0.062) for z in (0.006, 0.076)]
    corners += [(-0.05, y, z) for y in (-0.062, 0.062) for z in (0.006, 0.076)]
    box = trimesh.convex.convex_hull(np.array(corners))
    panel = trimesh.creation.box((0.004, 0.084, 0.058))
    panel.apply_translation((-0.1355, 0, 0.044))
    return [
        Shell("base", "foot", "grey", foot),
        Shell("base", "box", "grey", box),
        Shell("base", "panel", "dark", panel),
    ]


def _lower_elbow(
    body: str, length: float, radius: float, pivot: float, mirror: bool
) -> list[Shell]:
    """Links 1 and 3: from a roll joint up to the pitch joint, leaning to -y (or +y: mirror).

    Args:
        body: Name of the link.
        length: Height of the pitch axis above the roll joint (m).
        radius: Radius of the tube at the roll joint (m).
        pivot: Radius of the pitch housing (m).
        mirror: Lean to +y.
    """
    h, r, p = length, radius, pivot
    tube: list[Ring] = [
        (r, 0.006, -r, 0.006, r),
        (r, 0.030, -r, 0.030, r),
        (r - 0.003, 0.060, -r - 0.004, 0.062, r),
        (r - 0.012, h - p - 0.030, -r - 0.013, 0.105, r + 0.001),
        (r - 0.024, h - p - 0.012, -r - 0.022, h - 0.045, p - 0.001),
        (r - 0.036, h - p - 0.003, -r - 0.024, h + 0.005, p),
        (r - 0.043, h - p, -r - 0.021, h + 0.038, p),
        (r - 0.049, h - p, -r - 0.010, h + 0.058, p),
        (r - 0.055, h - p, -r + 0.012, h + p - 0.005, p),
        (0.006, h - p, -r + 0.036, h + p, p),
        (-0.002, h - p, -0.002, h + p, p),
    ]
    return [
        Shell(body, "roll_gap", "dark", _gap(r - 0.004)),
        Shell(body, "tube", "grey", _loft(tube, mirror)),
        Shell(body, "cap", "metal", _cap(r + 0.022, h, 0.046, not mirror)),
        Shell(body, "pitch_gap", "dark", _gap(p - 0.004, centre=(0, 0, h), axis="y")),
    ]


def _upper_elbow(
    body: str, length: float, radius: float, pivot: float, mirror: bool
) -> list[Shell]:
    """Links 2 and 4: from the pitch joint up to the next roll joint, leaning to +y (or -y: mirror).

    Args:
        body: Name of the link.
        length: Height of the roll joint above the pitch axis (m).
        radius: Radius of the tube at the roll joint (m).
        pivot: Radius of the pitch housing (m).
        mirror: Lean to -y.
    """
    r, p, end = radius, pivot, length - 0.006
    seam: Ring = (-r + 0.026, p + 0.013, r + 0.021, 0.046, p - 0.001)
    bulb: list[Ring] = [
        (0.002, p, 0.002, -p, p),
        (-0.005, p, r - 0.036, -p, p),
        (-0.0125, p, r - 0.0125, -p + 0.005, p),
        (-0.019, p, r + 0.010, -0.058, p),
        (-r + 0.040, p, r + 0.021, -0.038, p),
        (-r + 0.036, p + 0.002, r + 0.024, -0.005, p),
        (-r + 0.031, p + 0.007, r + 0.023, 0.022, p),
        seam,
    ]
    tube: list[Ring] = [
        seam,
        (-r + 0.012, p + 0.030, r + 0.013, 0.088, r + 0.001),
        (-r + 0.003, end - 0.050, r + 0.005, 0.136, r),
        (-r, end - 0.024, r, end - 0.024, r),
        (-r, end, r, end, r),
    ]
    return [
        Shell(body, "bulb", "orange", _loft(bulb, mirror)),
        Shell(body, "tube", "grey", _loft(tube, mirror)),
        Shell(body, "cap", "orange", _cap(r + 0.022, 0.0, 0.044, mirror)),
    ]


def _forearm() -> list[Shell]:
    """Link 5: a tube that narrows to a slim arm at -y, which holds the wrist."""
    r = 0.058
    tube: list[Ring] = [
        (r, 0.006, -r, 0.006, r),
        (r, 0.030, -r, 0.030, r),
        (r - 0.004, 0.055, -r - 0.003, 0.055, r - 0.001),
        (r - 0.016, 0.082, -r - 0.009, 0.080, r - 0.003),
        (0.016, 0.108, -r - 0.014, 0.104, r - 0.007),
        (-0.022, 0.126, -r - 0.018, 0.124, r - 0.010),
        (-0.047, 0.140, -r - 0.021, 0.140, r - 0.012),
        (-0.053, 0.160, -r - 0.022, 0.162, 0.046),
        (-0.054, 0.190, -r - 0.022, 0.190, 0.046),
        (-0.054, 0.213, -r - 0.021, 0.211, 0.040),
        (-0.055, 0.227, -r - 0.018, 0.224, 0.027),
        (-0.056, 0.234, -r - 0.014, 0.231, 0.012),
    ]
    return [
        Shell("link_5", "roll_gap", "dark", _gap(r - 0.004)),
        Shell("link_5", "tube", "grey", _loft(tube)),
        Shell("link_5", "cap", "metal", _cap(r + 0.020, 0.190, 0.034, negative=True)),
    ]


def _wrist() -> list[Shell]:
    """Link 6: a drum on the pitch axis, orange at its free end, and a neck up to link 7."""
    drum = _turned(
        [(0, -0.052), (0.046, -0.052), (0.050, -0.044), (0.052, 0.0), (0.051, 0.028), (0, 0.028)],
        axis="y",
    )
    dome = _turned(
        [
            (0, 0.029),
            (0.0515, 0.029),
            (0.050, 0.050),
            (0.045, 0.066),
            (0.035, 0.077),
            (0.020, 0.083),
            (0, 0.085),
        ],
        axis="y",
    )
    neck = _turned([(0, 0.0), (0.050, 0.0), (0.047, 0.040), (0.045, 0.056), (0, 0.056)])
    return [
        Shell("link_6", "drum", "grey", drum),
        Shell("link_6", "dome", "orange", dome),
        Shell("link_6", "neck", "grey", neck),
    ]


def _flange() -> list[Shell]:
    """Link 7: the turning end; its face is flat and nothing stands in front of it."""
    face = robot.FLANGE_HEIGHT_M - robot.JOINT_HEIGHTS_M[6]
    hub = _turned(
        [(0, -0.018), (0.044, -0.018), (0.045, 0.022), (0.042, 0.028), (0, 0.028)],
    )
    disc = _turned(
        [(0, 0.028), (0.034, 0.028), (0.034, 0.034), (0.0315, 0.036), (0.0315, face), (0, face)],
    )
    return [
        Shell("link_7", "roll_gap", "dark", _gap(0.0425, (0, 0, -0.021))),
        Shell("link_7", "hub", "grey", hub),
        Shell("link_7", "disc", "metal", disc),
    ]


@functools.cache
def link_shells() -> tuple[Shell, ...]:
    """All shells of the robot, base first."""
    return tuple(
        _base()
        + _lower_elbow("link_1", length=0.190, radius=0.072, pivot=0.074, mirror=False)
        + _upper_elbow("link_2", length=0.210, radius=0.068, pivot=0.074, mirror=False)
        + _lower_elbow("link_3", length=0.190, radius=0.068, pivot=0.070, mirror=True)
        + _upper_elbow("link_4", length=0.210, radius=0.062, pivot=0.070, mirror=True)
        + _forearm()
        + _wrist()
        + _flange()
    )


def solid_inertia(body: str) -> tuple[float, FloatArray, FloatArray]:
    """Mass properties of a link's closed shells filled at a density of 1 kg/m^3.

    The masses are published, their distribution is not: ``robot`` holds these properties, scaled to
    the published mass. Bands and caps are open surfaces and do not count; where two solids of a
    link overlap, the overlap counts twice.

    Args:
        body: Name of the link.

    Returns:
        Volume (m^3), centre of mass (3,) in m and inertia about it (3, 3) in m^5, link frame.
    """
    solids = []
    for shell in link_shells():
        mesh = shell.mesh.copy()
        mesh.merge_vertices()
        if shell.body == body and mesh.is_watertight:
            solids.append(mesh)
    volume = sum(float(solid.volume) for solid in solids)
    centre = sum(solid.volume * solid.center_mass for solid in solids) / volume
    inertia = np.zeros((3, 3))
    for solid in solids:
        arm = solid.center_mass - centre
        steiner = arm @ arm * np.eye(3) - np.outer(arm, arm)
        inertia += solid.moment_inertia + solid.volume * steiner
    return volume, np.asarray(centre), inertia


def add_shells(root: mjcf.RootElement) -> tuple[Any, ...]:
    """Adds the shells to the robot's tree as visual geoms and returns these.

    The colours are the materials ``shell_<paint>``, so that a task can vary them in one place.
    """
    for paint, rgba in PAINT_RGBA.items():
        root.asset.add("material", name=f"shell_{paint}", rgba=rgba, specular=0.4, shininess=0.5)
    geoms = []
    for shell in link_shells():
        name = f"{shell.body}_{shell.name}"
        root.asset.add(
            "mesh",
            name=name,
            vertex=np.round(shell.mesh.vertices, 6).ravel(),
            face=shell.mesh.faces.ravel(),
            inertia="shell",
        )
        geoms.append(
            root.find("body", shell.body).add(
                "geom",
                name=f"{name}_shell",
                type="mesh",
                mesh=name,
                material=f"shell_{shell.paint}",
                contype=0,
                conaffinity=0,
                mass=0,
                group=robot.SHELL_GROUP,
            )
        )
    return tuple(geoms)
