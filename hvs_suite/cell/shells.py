"""Visual shells of the iiwa, as geoms without mass or contact (first version: primitives)."""

from typing import Any

from dm_control import mjcf

from hvs_suite.cell import robot

_GREY = (0.80, 0.81, 0.82, 1)
_ORANGE = (0.95, 0.42, 0.08, 1)


def add_shells(root: mjcf.RootElement) -> tuple[Any, ...]:
    """Adds the visual geoms to the robot tree and returns them."""
    shells = []
    for geom in list(root.find_all("geom")):
        body = geom.parent
        orange = body.name in ("link_2", "link_4", "link_6")
        shells.append(
            body.add(
                "geom",
                name=f"{geom.name.replace('collision', 'shell')}",
                type=geom.type,
                fromto=geom.fromto,
                size=geom.size,
                contype=0,
                conaffinity=0,
                mass=0,
                group=robot.SHELL_GROUP,
                rgba=_ORANGE if orange else _GREY,
            )
        )
    return tuple(shells)
