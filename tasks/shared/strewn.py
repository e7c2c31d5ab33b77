"""Things strewn over the table that are not the target, for studies of any family.

The family `clutter` is about such things and has rules of its own. Here policies are not told of
them: discs of other colours, and squares and half discs of the target's, as large as the target.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.props import Placed, Props

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.prop import Shape
    from hvs_suite.tasks.shared.scenario import Streams
    from hvs_suite.tasks.shared.spec import Spec

FloatArray = npt.NDArray[np.float64]

_KINDS: "tuple[tuple[Shape, str], ...]" = (
    ("square", "red"),
    ("disc", "blue"),
    ("half disc", "red"),
    ("disc", "yellow"),
    ("disc", "green"),
)
INNER_M = 0.40
"""How near to the base's axis things may lie (m)."""
APART_M = 0.10
"""Least distance between their middles, and from what else lies there (m)."""
_MAX_REDRAWS = 1000


class Strewn:
    """The things of one cell; each scene has all of them, in other places.

    Args:
        cell: What they are attached to.
        spec: How many they are, and how large.
    """

    def __init__(self, cell: "Cell", spec: "Spec") -> None:
        from hvs_suite.cell.prop import Sticker

        self._outer_m = spec.reach_m
        kinds = [_KINDS[number % len(_KINDS)] for number in range(spec.n_strewn)]
        self._props = Props(
            cell,
            [
                Sticker(f"strewn-{number}", shape, colour, spec.target_size_m)
                for number, (shape, colour) in enumerate(kinds)
            ],
        )

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look them up in the compiled model."""
        self._props.after_compile(physics)

    def lay(self, physics: "mjcf.Physics", streams: "Streams", occupied: FloatArray) -> None:
        """Lay all of them on the table.

        Args:
            physics: The compiled cell.
            streams: Of the scene.
            occupied: Places that they keep away from, (n, 2) m, base frame.

        Raises:
            OptionError: There is no room for them.
        """
        random = streams.generator("strewn")
        taken = [*occupied]
        for name in self._props.names:
            for _ in range(_MAX_REDRAWS):
                radius = math.sqrt(random.uniform(INNER_M**2, self._outer_m**2))
                azimuth, yaw = random.uniform(-math.pi, math.pi, 2)
                place = np.array([radius * math.cos(azimuth), radius * math.sin(azimuth)])
                if all(math.dist(place, other) >= APART_M for other in taken):
                    break
            else:
                raise OptionError(
                    f"no room for {len(self._props.names)} things {APART_M} m apart; lower n_strewn"
                )
            taken.append(place)
            self._props.put(physics, Placed(name, np.array([*place, 0.0, yaw])))
