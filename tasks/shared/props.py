"""Props of a scene: mocap bodies that a scenario puts somewhere, and that are parked otherwise."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.prop import Prop

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Placed:
    """A prop that a scene puts somewhere.

    Attributes:
        prop: Its name.
        pose: x, y, z (m) and yaw (rad), (4,).
    """

    prop: str
    pose: FloatArray


class Props:
    """All props of a family.

    Args:
        cell: What they are attached to.
        props: They, each with a name of its own.

    Attributes:
        names: Of all of them, in order.
        geoms: Index of each one's first geom in the compiled model, by name.
    """

    def __init__(self, cell: "Cell", props: "Sequence[Prop]") -> None:
        self._props = {prop.mjcf_model.model: prop for prop in props}
        self.names = tuple(self._props)
        self.geoms: dict[str, int] = {}
        for prop in props:
            cell.add_prop(prop)

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look them up in the compiled model."""
        model = physics.model
        for name, prop in self._props.items():
            self.geoms[name] = int(physics.bind(prop.geom).element_id)
        self._mocaps = {
            name: int(model.body_mocapid[model.geom_bodyid[geom]])
            for name, geom in self.geoms.items()
        }

    def put(self, physics: "mjcf.Physics", placed: Placed) -> None:
        """Put a prop somewhere."""
        data, mocap = physics.data.ptr, self._mocaps[placed.prop]
        *place, yaw = placed.pose.tolist()
        data.mocap_pos[mocap] = place
        data.mocap_quat[mocap] = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]

    def park(self, physics: "mjcf.Physics") -> None:
        """Put all props out of sight."""
        from hvs_suite.cell.prop import PARKED_M

        for name in self.names:
            self.put(physics, Placed(name, np.array([*PARKED_M, 0.0])))
