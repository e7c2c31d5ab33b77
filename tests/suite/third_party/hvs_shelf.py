"""``shelf``: hold the flange over a target that lies on a block, at a height that varies.

A family of a package of its own: `pip install` it beside hvs_suite, and its tasks are there.
"""

import dataclasses
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from dm_control import mjcf

from hvs_suite.cell.arena import Cell
from hvs_suite.cell.robot import SCENE_BIT
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.shared.goal import UP, Goal
from hvs_suite.tasks.shared.placing import Placing, PlacingSpec
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import scene

HALF_SIDE_M = 0.04


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShelfSpec(PlacingSpec):
    """Every parameter of ``shelf``.

    Attributes:
        height_m: Least and largest height of the block (m).
    """

    family: ClassVar[str] = "shelf"

    height_m: tuple[float, float] = scene((0.01, 0.03))
    ring_m: tuple[float, float] = scene((0.45, 0.70))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.height_m[0] <= self.height_m[1] <= 0.2:
            raise OptionError(f"height_m is {self.height_m}; use a least and a larger one to 0.2 m")


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ShelfScenario(Scenario):
    """One scene.

    Attributes:
        target: Centre of the target on top of the block, (3,) m, base frame.
    """

    target: npt.NDArray[np.float64]


class Shelf(Placing[ShelfSpec, ShelfScenario]):
    """One still target on a block."""

    def build(self, cell: Cell) -> None:
        """Add the block, which moves with the scenario, and the marker."""
        super().build(cell)
        side = HALF_SIDE_M
        block = cell.mjcf_model.worldbody.add("body", name="block", mocap=True)
        self._block = block.add(
            "geom",
            type="box",
            size=[side, side, 0.1],
            rgba=[0.3, 0.3, 0.35, 1.0],
            group=1,
            contype=SCENE_BIT,
            conaffinity=0,
        )

    def after_compile(self, physics: mjcf.Physics) -> None:
        """Look up the block in the compiled model."""
        super().after_compile(physics)
        body = physics.model.geom_bodyid[physics.bind(self._block).element_id]
        self._row = int(physics.model.body_mocapid[body])

    def draw(self, streams: Streams) -> ShelfScenario:
        """Draw target, start and look."""
        x, y = self.draw_on_ring(streams.generator("target"))
        target = np.array([x, y, streams.generator("height").uniform(*self.spec.height_m)])
        goal = Goal(target, UP, self.spec.standoff_m)
        return ShelfScenario(target=target, **self.draw_common(streams, goal))

    def begin(self, physics: mjcf.Physics, scenario: ShelfScenario) -> None:
        """Put the block up, and the marker on it."""
        super().begin(physics, scenario)
        # Ten centimetres of block on either side of its centre; the table hides what is below.
        physics.data.mocap_pos[self._row] = scenario.target - 0.1 * UP
        self.put_marker(physics, self.goal())

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return Goal(self.scenario.target, UP, self.spec.standoff_m)


_EASY = ShelfSpec(name="shelf-easy", position_tolerance_mm=5.0, tilt_tolerance_deg=5.0)

register(Shelf, _EASY, dataclasses.replace(_EASY, name="shelf-high", height_m=(0.03, 0.06)))
