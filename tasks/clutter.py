"""``clutter``: place the flange over the right thing, among others, without touching anything.

Three things make it hard. *Distractors*: discs of other colours, and squares, rings and half discs
of the target's own. The rule: the target is the one whole disc of its colour; everything else
differs from it in colour or in outline, and lies at least ``spacing_m`` away. *Choice*: several
discs, and the sentence and an observation say the colour of the one that is meant. *Obstacles*:
posts, boxes and an overhang, which may hide the target from the eye to hand; one of them moves
along a lane that is painted on the surface, at a moment that nobody is told. Touching anything
ends the episode. A way around all of them exists by the rule of `hvs_suite.tasks.shared.room`.

The expert keeps off the whole lane until what moves there has come to rest: it knows no more than
the paint shows.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import robustness
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.placing import HARD, Placing, PlacingSpec
from hvs_suite.tasks.shared.props import Placed, Props
from hvs_suite.tasks.shared.robustness import Axis
from hvs_suite.tasks.shared.scenario import Scenario, Streams, draw_look
from hvs_suite.tasks.shared.spec import Description, VectorObservation, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.prop import Shape
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

COLOURS = ("red", "blue", "green", "yellow")
"""Of the discs; the same as the cell's paints, spelled out because those load MuJoCo."""
GOAL_COLOUR = "goal_colour"
OUTLINES: tuple[Literal["square", "ring", "half disc"], ...] = ("square", "ring", "half disc")
"""What is not the target although it has its colour."""
MAX_OBSTACLES = 6
MAX_HEIGHT_M = 0.50
"""How many obstacles there are and how high; spelled out for the same reason."""
_PACKING = 0.3
"""Share of the ring that things may fill with the room that they keep; more is seldom found."""
_MAX_REDRAWS = 1000
_MARKER = "disc-red"
"""The disc that is the marker of all families."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClutterSpec(PlacingSpec):
    """Every parameter of ``clutter``.

    Attributes:
        colours: Colours of the discs that may be meant; one of each lies there.
        n_distractors: Fewest and most things that are never meant.
        spacing_m: Least distance between the middles of things that lie on the surface (m).
        n_obstacles: Fewest and most obstacles.
        obstacle_height_m: Least and largest height of an obstacle (m).
        moves: Whether the first obstacle moves in mid-episode.
        moves_at_s: When it begins, earliest and latest (s).
        speed_m_s: How fast it moves, least and most (m/s).
    """

    family: ClassVar[str] = "clutter"

    colours: tuple[str, ...] = scene(("red",))
    n_distractors: tuple[int, int] = scene((0, 0))
    spacing_m: float = scene(0.10)
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
        if self.marker != "disc":
            raise OptionError(f"marker is {self.marker!r}; clutter's targets are discs")
        for colour in self.colours:
            if colour not in COLOURS:
                raise OptionError(f"colours has {colour!r}, which is none of {', '.join(COLOURS)}")
        if not self.colours or len(set(self.colours)) < len(self.colours):
            raise OptionError(f"colours is {self.colours}; name one or several, each once")
        for name in ("n_distractors", "n_obstacles", "moves_at_s", "speed_m_s"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise OptionError(f"{name} is {(low, high)}; use a least and a larger value")
        self._check("must be positive", lambda value: value > 0, "spacing_m")
        inner, outer = self.ring_m
        most = int(_PACKING * (outer**2 - inner**2) / (0.5 * self.spacing_m) ** 2)
        wanted = self.n_distractors[1] + len(self.colours)
        if wanted > most:
            raise OptionError(
                f"n_distractors is {self.n_distractors}: {wanted} things do not fit on the ring, "
                f"{self.spacing_m} m apart; use at most {most - len(self.colours)}"
            )
        if self.n_obstacles[1] > MAX_OBSTACLES:
            raise OptionError(f"n_obstacles is {self.n_obstacles}; use at most {MAX_OBSTACLES}")
        low, high = self.obstacle_height_m
        if not 0.05 <= low <= high <= MAX_HEIGHT_M:
            raise OptionError(
                f"obstacle_height_m is {(low, high)}; use heights from 0.05 to {MAX_HEIGHT_M} m"
            )
        if self.moves and not self.n_obstacles[0]:
            raise OptionError("moves needs an obstacle that can move; raise n_obstacles")

    @property
    def further_observations(self) -> dict[str, VectorObservation]:
        """One for the colour that is meant, 0 for the others, where there is a choice."""
        if len(self.colours) == 1:
            return {}
        return {GOAL_COLOUR: VectorObservation(self.colours, 0.0, 1.0)}

    def instruction(self, scenario: Scenario | None = None) -> str:
        """The task as one sentence, which names the colour that is meant."""
        if isinstance(scenario, ClutterScenario):
            thing = f"the {scenario.colour} disc"
        elif len(self.colours) > 1:
            thing = "the disc of the colour that is asked for"
        else:
            thing = f"the {self.colours[0]} disc"
        careful = ", without touching anything" if self.n_obstacles[1] else ""
        return (
            f"Place the flange centred over {thing}, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface{careful}."
        )

    def robustness_axes(self) -> tuple[Axis, ...]:
        """Without another marker: the task names its colour and its outline."""
        none = Axis(
            "marker",
            "unseen marker",
            "colour and outline are what tells the target from the others",
        )
        return robustness.replaced(super().robustness_axes(), none)

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        disc, parts = f"{self.target_diameter_m * 1000:.0f} mm disc", []
        if len(self.colours) > 1:
            disc = f"{disc}, the one of {len(self.colours)} that is asked for"
        if self.n_distractors[1]:
            parts.append(f"among {_range(self.n_distractors)} other things")
        if self.n_obstacles[1]:
            moving = ", one of which moves" if self.moves else ""
            parts.append(f"behind {_range(self.n_obstacles)} obstacles{moving}")
        return dataclasses.replace(words, target=" ".join([disc, *parts]))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ClutterScenario(Scenario):
    """One scene.

    Attributes:
        target: Centre of the target, (3,) m, base frame.
        colour: Its colour.
        placed: Everything that lies or stands there, the target included.
        way: Postures of the way that is free of obstacles, (3, 7) rad; (0, 7) without obstacles.
        motion: When the first obstacle begins to move (s), and its speed (m/s), (2,); None where
            none moves.
    """

    target: FloatArray
    colour: str
    placed: tuple[Placed, ...]
    way: FloatArray
    motion: FloatArray | None


class Clutter(Placing[ClutterSpec, ClutterScenario]):
    """One target among other things."""

    hard: ClassVar[Mapping[str, str]] = {
        "clutter-distractors": (
            "Squares, rings and half discs have the target's colour, other discs its outline; "
            "only both together tell which thing is meant, from far off and at a slant."
        ),
        "clutter-choice": (
            "The pictures do not say which disc is meant; the sentence and an observation do, "
            "so that a policy has to join the two."
        ),
        "clutter-obstacles": (
            "Posts, boxes and an overhang stand in the way and may hide the target from the eye "
            "to hand, and one of them moves at a moment that nobody knows. Touching anything "
            "ends the episode."
        ),
    }

    certificate_passes: ClassVar[int] = 4

    def build(self, cell: "Cell") -> None:
        """Attach the target's discs and all props."""
        from hvs_suite.cell.prop import Sticker
        from hvs_suite.tasks.shared.obstacles import Obstacles

        super().build(cell)
        spec, size = self.spec, self.spec.target_diameter_m
        stickers = [
            Sticker(_disc(colour), "disc", colour, size)
            for colour in spec.colours
            if _disc(colour) != _MARKER
        ]
        self._kinds = {_disc(colour): f"{colour} disc" for colour in spec.colours}
        self._others = []
        for number, (outline, colour) in enumerate(self._distractors()):
            name = f"thing-{number}"
            self._kinds[name] = f"{colour} {outline}"
            self._others.append(name)
            stickers.append(Sticker(name, outline, colour, size))
        self._obstacles = Obstacles(spec.n_obstacles, spec.obstacle_height_m, moves=spec.moves)
        self._props = Props(cell, [*stickers, *self._obstacles.props])

    def _distractors(self) -> "list[tuple[Shape, str]]":
        """Outline and colour of everything that can be put there to distract, one prop each."""
        spec = self.spec
        if not spec.n_distractors[1]:
            return []
        kinds: list[tuple[Shape, str]] = [
            ("disc", colour) for colour in COLOURS if colour not in spec.colours
        ]
        kinds += [(outline, colour) for outline in OUTLINES for colour in spec.colours]
        # Two of each, and more where that is not enough.
        count = max(2 * len(kinds), spec.n_distractors[1])
        return [kinds[number % len(kinds)] for number in range(count)]

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up marker and props in the compiled model."""
        super().after_compile(physics)
        self._props.after_compile(physics)
        self._disc_geoms = {_MARKER: self.marker_geom, **self._props.geoms}

    def draw(self, streams: Streams) -> ClutterScenario:
        """Draw target, start, what lies around, what stands around, and look."""
        from hvs_suite.tasks.shared.start import draw_start

        spec = self.spec
        goal = self.goal_over(*self.draw_on_ring(streams.generator("target")))
        own = self.named.start if self.named is not None else "zero"
        start = draw_start(spec, own, streams, goal, goal.normal)
        colour = spec.colours[streams.generator("goal_colour").integers(len(spec.colours))]
        placed = self._lay_out(streams.generator("things"), colour, goal)
        way: FloatArray = np.zeros((0, 7))
        motion = None
        if spec.n_obstacles[1]:
            way, standing = self._obstacles.draw(streams.generator("obstacles"), start, goal)
            placed += standing
        if spec.moves:
            random = streams.generator("motion")
            motion = np.array([random.uniform(*spec.moves_at_s), random.uniform(*spec.speed_m_s)])
        return ClutterScenario(
            target=goal.target,
            colour=colour,
            placed=tuple(placed),
            way=way,
            motion=motion,
            start=start,
            **draw_look(spec, streams),
        )

    def _lay_out(self, random: np.random.Generator, colour: str, goal: Goal) -> list[Placed]:
        """Lay all that is flat on the ring, each thing at a distance from all others."""
        spec = self.spec
        things = [_disc(each) for each in spec.colours if each != colour]
        low, high = spec.n_distractors
        count = int(random.integers(low, high + 1))
        chosen = random.permutation(len(self._others))[:count]
        things += [self._others[number] for number in chosen]
        middles = [goal.target[:2]]
        for _ in things:
            for _ in range(_MAX_REDRAWS):
                place = np.array(self.draw_on_ring(random))
                if np.linalg.norm(np.subtract(middles, place), axis=1).min() >= spec.spacing_m:
                    break
            else:
                raise OptionError(
                    f"no room for {len(things)} things, {spec.spacing_m} m apart; lower "
                    "n_distractors or spacing_m"
                )
            middles.append(place)
        yaws = random.uniform(-math.pi, math.pi, len(middles))
        return [
            Placed(name, np.array([*place, 0.0, yaw]))
            for name, place, yaw in zip([_disc(colour), *things], middles, yaws, strict=True)
        ]

    def begin(self, physics: "mjcf.Physics", scenario: ClutterScenario) -> None:
        """Put everything where it belongs, and park the rest."""
        import mujoco

        from hvs_suite.cell.prop import PARKED_M
        from hvs_suite.tasks.shared.obstacles import CARRIAGE, LANE

        super().begin(physics, scenario)
        self._goal = self.goal_over(*scenario.target[:2])
        self._props.park(physics)
        self.put_marker(physics, Goal(np.array(PARKED_M), self._goal.normal))
        for each in scenario.placed:
            if each.prop == _MARKER:
                self.put_marker(physics, self.goal_over(*each.pose[:2]))
            else:
                self._props.put(physics, each)
        self.marker_geom = self._disc_geoms[_disc(scenario.colour)]
        self._carriage = next((p for p in scenario.placed if p.prop == CARRIAGE), None)
        if self._carriage is not None and scenario.motion is not None:
            lying = np.array([1.0, 1.0, 0.0, 1.0]) * self._carriage.pose
            self._props.put(physics, Placed(LANE, lying))
        self.advance(physics, 0.0)
        # The picture that follows shows where bodies were computed to be.
        mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)

    def advance(self, physics: "mjcf.Physics", time_s: float) -> None:
        """Move the obstacle that moves."""
        from hvs_suite.tasks.shared.obstacles import LANE_M, moved

        motion = self.scenario.motion
        if motion is None or self._carriage is None:
            return
        begins_s, speed = motion
        self._way_m = min(max(speed * (time_s - begins_s), 0.0), LANE_M)
        self._has_come = self._way_m >= LANE_M
        self._props.put(physics, moved(self._carriage, self._way_m))

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return self._goal

    def observe(self, physics: "mjcf.Physics") -> dict[str, FloatArray]:
        """Which colour is meant."""
        meant = [float(colour == self.scenario.colour) for colour in self.spec.colours]
        return {GOAL_COLOUR: np.array(meant)}

    def things(self) -> list[tuple[str, FloatArray]]:
        """Colour and outline of what lies on the surface, and where (2,) m; the target first."""
        return [
            (self._kinds[each.prop], each.pose[:2])
            for each in self.scenario.placed
            if each.prop in self._kinds
        ]

    def occupied(self) -> FloatArray:
        """Where anything lies or stands."""
        return np.array([each.pose[:2] for each in self.scenario.placed])

    def obstacles(self) -> tuple["Solid", ...]:
        """All obstacles; the one that moves with all its lane until it rests."""
        solids: list[Solid] = []
        for each in filter(self._obstacles.is_one, self.scenario.placed):
            rests = each is self._carriage and self.scenario.motion is not None and self._has_come
            solids += self._obstacles.solids(each, self._way_m if rests else 0.0)
        return tuple(solids)

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Reachable, in time, unambiguous, observable and accurate; a clear way where needed."""
        from hvs_suite.tasks.shared import certificate
        from hvs_suite.tasks.shared import certificate_room as room

        return [
            *certificate.check_geometry(env, scenarios),
            *room.check_unambiguous(env, scenarios),
            *(
                room.check_clear_way(env, scenarios)
                if env.task.family.spec.n_obstacles[1]
                else certificate.check_visibility(env, scenarios, room.find_by_outline, 95.0)
            ),
            *certificate.check_accuracy(env, scenarios, room.find_by_outline),
        ]


def _disc(colour: str) -> str:
    """Name of the disc of a colour."""
    return f"disc-{colour}"


def _range(numbers: tuple[int, int]) -> str:
    low, high = numbers
    return f"{low}" if low == high else f"{low} to {high}"


_DISTRACTORS = ClutterSpec(
    name="clutter-distractors",
    n_distractors=(6, 10),
    # At 112 px a disc and a square of its size look alike to the eye to hand.
    eth_resolution=336,
)

register(
    Clutter,
    _DISTRACTORS,
    dataclasses.replace(_DISTRACTORS, name="clutter-choice", n_distractors=(0, 0), colours=COLOURS),
    ClutterSpec(
        name="clutter-obstacles",
        start="random",
        target_diameter_m=0.030,
        n_obstacles=(2, 5),
        moves=True,
        time_limit_steps=60,
        **HARD,
    ),
)
