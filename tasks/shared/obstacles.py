"""Obstacles: posts, boxes and an overhang that stand around the target, and one that moves.

They stand where a way stays free (see `hvs_suite.tasks.shared.room`): the one that moves wherever
there is room for all of its lane, the next near the target, the others anywhere in reach.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.props import Placed, Props
from hvs_suite.tasks.shared.spec import Spec, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.prop import Obstacle, Prop
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.room import Room

FloatArray = npt.NDArray[np.float64]

HEIGHT_M = 0.50
"""Of all obstacles in the model; a lower one is sunk into the table."""
MAX_OBSTACLES = 6
"""How many there are."""
CARRIAGE, LANE, OVERHANG = "carriage", "lane", "overhang"
LANE_M = 0.30
"""How far the carriage moves (m)."""
_LANE_WIDTH_M = 0.09
_NEAR_M = (0.10, 0.30)
_ANYWHERE_M = (0.25, 0.85)
_LEAST_OVERHANG_M = 0.35
_OVERHANG_TURN = 0.2
"""Share of a full turn by which an overhang may miss the target."""
_MAX_ARRANGEMENTS = 100
_MAX_TRIES = 200
_WHITE, _SLATE, _WOOD = (0.93, 0.93, 0.90, 1.0), (0.30, 0.33, 0.38, 1.0), (0.55, 0.42, 0.28, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObstaclesSpec(Spec):
    """Parameters of what stands around.

    Attributes:
        n_obstacles: Fewest and most obstacles.
        obstacle_height_m: Least and largest height of an obstacle (m).
        moves: Whether the first obstacle moves in mid-episode.
        moves_at_s: When it begins, earliest and latest (s).
        speed_m_s: How fast it moves, least and most (m/s).
    """

    n_obstacles: tuple[int, int] = scene((0, 0))
    obstacle_height_m: tuple[float, float] = scene((0.10, 0.50))
    moves: bool = scene(False)
    moves_at_s: tuple[float, float] = scene((0.3, 1.5))
    speed_m_s: tuple[float, float] = scene((0.10, 0.20))

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check_range("moves_at_s", "speed_m_s")
        self._check_range("n_obstacles", most=MAX_OBSTACLES)
        self._check_range("obstacle_height_m", least=0.05, most=HEIGHT_M)
        if self.moves and not self.n_obstacles[0]:
            raise OptionError("moves needs an obstacle that can move; raise n_obstacles")


def _bank() -> "list[Obstacle]":
    """All that may stand there, at full height."""
    from hvs_suite.cell.prop import Obstacle
    from hvs_suite.cell.solid import Solid

    h = 0.5 * HEIGHT_M

    def post(radius: float) -> "Solid":
        return Solid("cylinder", (radius, radius, h), (0.0, 0.0, h))

    def box(a: float, b: float) -> "Solid":
        return Solid("box", (a, b, h), (0.0, 0.0, h))

    beam = Solid("box", (0.16, 0.03, 0.02), (0.16, 0.0, HEIGHT_M - 0.02))
    return [
        Obstacle(CARRIAGE, [post(0.035)], _WHITE),
        Obstacle("post-thin", [post(0.02)], _SLATE),
        Obstacle("post-thick", [post(0.04)], _WOOD),
        Obstacle("box", [box(0.05, 0.04)], _WOOD),
        Obstacle("wall", [box(0.10, 0.015)], _WHITE),
        Obstacle(OVERHANG, [box(0.025, 0.025), beam], _SLATE),
    ]


class Obstacles:
    """The obstacles of a family: how they are arranged, and where they are.

    Args:
        spec: How many, and whether one moves; none is made where there is none in any scene.
    """

    def __init__(self, spec: ObstaclesSpec) -> None:
        self._spec = spec
        bank = _bank() if spec.n_obstacles[1] else []
        self._by_name = {each.mjcf_model.model: each for each in bank}

    @property
    def props(self) -> "list[Prop]":
        """Obstacles, and the lane of the one that moves."""
        from hvs_suite.cell.prop import Lane

        lane = [Lane(LANE, LANE_M, _LANE_WIDTH_M)] if self._spec.moves else []
        return [*lane, *self._by_name.values()]

    def draw(
        self, random: np.random.Generator, start: FloatArray, goal: Goal
    ) -> tuple[FloatArray, list[Placed]]:
        """Draw a way, and obstacles that leave it free.

        Args:
            random: Draws.
            start: Where the arm stands at reset, (7,) rad.
            goal: Where the tip has to be.

        Returns:
            The way, (3, 7) rad, and the obstacles, the carriage first.

        Raises:
            OptionError: There is no room for the fewest.
        """
        from hvs_suite.tasks.shared.room import Room, draw_way

        low, high = self._spec.n_obstacles
        moving = [CARRIAGE] * self._spec.moves
        others = [name for name in self._by_name if name not in moving]
        for _ in range(_MAX_ARRANGEMENTS):
            way = draw_way(random, start, goal)
            room = Room(start, way, goal.target)
            count = int(random.integers(low, high + 1))
            names = [*moving, *(others[i] for i in random.permutation(len(others)))][:count]
            found = [
                self._find_room(random, room, name, goal.target, is_near=number == len(moving))
                for number, name in enumerate(names)
            ]
            placed = [each for each in found if each is not None]
            if len(placed) >= low and set(moving) <= {each.prop for each in placed}:
                return way, placed
        raise OptionError(
            f"no room for {low} obstacles around the way to {goal.target.round(3).tolist()}; lower "
            "n_obstacles"
        )

    def _find_room(
        self,
        random: np.random.Generator,
        room: "Room",
        name: str,
        target: FloatArray,
        *,
        is_near: bool,
    ) -> Placed | None:
        """Put an obstacle where it fits: near the target if there is room, or anywhere."""
        for near in (True, False) if is_near else (False,):
            for _ in range(_MAX_TRIES):
                placed = Placed(name, self._draw_pose(random, name, target, near=near))
                solids = self.solids(placed)
                if room.fits(solids):
                    room.add(solids)
                    return placed
        return None

    def _draw_pose(
        self, random: np.random.Generator, name: str, target: FloatArray, *, near: bool
    ) -> FloatArray:
        """Draw where an obstacle stands, (4,): near the target, or anywhere in reach."""
        low, high = self._spec.obstacle_height_m
        yaw, away = random.uniform(-math.pi, math.pi, 2)
        if near:
            distance, middle = random.uniform(*_NEAR_M), target[:2]
        else:
            inner, outer = _ANYWHERE_M
            distance, middle = math.sqrt(random.uniform(inner**2, outer**2)), np.zeros(2)
        x, y = middle + distance * np.array([math.cos(away), math.sin(away)])
        if name == OVERHANG:
            low = max(low, min(high, _LEAST_OVERHANG_M))
            # It reaches over the target, more or less.
            yaw = math.atan2(target[1] - y, target[0] - x) + _OVERHANG_TURN * yaw
        return np.array([x, y, random.uniform(low, high) - HEIGHT_M, yaw])

    def begin(
        self,
        physics: "mjcf.Physics",
        props: Props,
        placed: Iterable[Placed],
        motion: FloatArray | None,
    ) -> None:
        """Begin an episode.

        Args:
            physics: The compiled cell.
            props: All of the family, these among them, put where they belong.
            placed: What is there, obstacles among other things.
            motion: When the carriage begins to move (s), and its speed (m/s); None if it does not.
        """
        self._props, self._motion, self._way_m = props, motion, 0.0
        self._standing = [each for each in placed if each.prop in self._by_name]
        self._carriage = None
        if motion is not None:
            self._carriage = next((p for p in self._standing if p.prop == CARRIAGE), None)
        if self._carriage is not None:
            props.put(physics, Placed(LANE, np.array([1.0, 1.0, 0.0, 1.0]) * self._carriage.pose))
        self.advance(physics, 0.0)

    def advance(self, physics: "mjcf.Physics", time_s: float) -> None:
        """Move the carriage to where it is at a time since the reset (s)."""
        if self._motion is None or self._carriage is None:
            return
        begins_s, speed = self._motion
        self._way_m = min(max(speed * (time_s - begins_s), 0.0), LANE_M)
        self._props.put(physics, moved(self._carriage, self._way_m))

    def present(self) -> "tuple[Solid, ...]":
        """What all fill; the carriage with all its lane until it rests."""
        solids: list[Solid] = []
        for each in self._standing:
            rests = each is self._carriage and self._way_m >= LANE_M
            solids += self.solids(each, self._way_m if rests else 0.0)
        return tuple(solids)

    def solids(self, placed: Placed, way_m: float = 0.0) -> "list[Solid]":
        """What an obstacle fills; the carriage, all from where it has come to its lane's end.

        Args:
            placed: Where it stood at the reset.
            way_m: How far along its lane it rests for good (m); 0 as long as it may still move.
        """
        *place, yaw = placed.pose.tolist()
        solids = [solid.moved(place, yaw) for solid in self._by_name[placed.prop].solids]
        if placed.prop != CARRIAGE or not self._spec.moves:
            return solids
        if way_m:
            ahead = moved(placed, way_m)
            *place, yaw = ahead.pose.tolist()
            return [solid.moved(place, yaw) for solid in self._by_name[placed.prop].solids]
        return [solid.swept((LANE_M * math.cos(yaw), LANE_M * math.sin(yaw))) for solid in solids]


def moved(placed: Placed, way_m: float) -> Placed:
    """Something some way ahead (m) along its own x axis."""
    x, y, z, yaw = placed.pose
    pose = np.array([x + way_m * math.cos(yaw), y + way_m * math.sin(yaw), z, yaw])
    return dataclasses.replace(placed, pose=pose)
