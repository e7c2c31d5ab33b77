"""``clutter``: place the flange over the right object, without touching anything.

Three things make it hard. *Distractors*: discs of other colours, and squares, rings and half discs
of the target's own. The rule: the target is the one whole disc of its colour; everything else
differs from it in colour or in outline, and lies at least ``spacing_m`` away. *Choice*: several
discs, and the sentence and an observation say the colour of the one that is meant. *Obstacles*:
posts, boxes and an overhang, which may hide the target from the eye to hand; one of them moves
along a lane that is painted on the surface, and the policy is not told when. Touching anything ends
the episode. A way around all of them exists by the rule of `hvs_suite.tasks.shared.room`.

The expert avoids the whole lane until the moving obstacle has come to rest, because it also knows
only the paint.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import robustness
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.obstacles import Obstacles, ObstaclesSpec
from hvs_suite.tasks.shared.placing import HARD, Placing, PlacingSpec
from hvs_suite.tasks.shared.props import Placed, Props
from hvs_suite.tasks.shared.robustness import Axis
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import Description, VectorObservation
from hvs_suite.tasks.shared.things import COLOURS, MARKER, Things, ThingsSpec, disc_name

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

GOAL_COLOUR = "goal_colour"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClutterSpec(ThingsSpec, ObstaclesSpec, PlacingSpec):
    """Every parameter of ``clutter``."""

    family: ClassVar[str] = "clutter"

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        if self.marker != "disc":
            raise OptionError(f"marker is {self.marker!r}; clutter's targets are discs")

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
        thing, parts = f"{self.target_diameter_m * 1000:.0f} mm disc", []
        if len(self.colours) > 1:
            thing = f"{thing}, the one of {len(self.colours)} that is asked for"
        if self.n_distractors[1]:
            parts.append(f"among {_range(self.n_distractors)} other things")
        if self.n_obstacles[1]:
            moving = ", one of which moves" if self.moves else ""
            parts.append(f"behind {_range(self.n_obstacles)} obstacles{moving}")
        return dataclasses.replace(words, target=" ".join([thing, *parts]))


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
            "Squares, rings and half discs have the target's colour, and other discs have its "
            "outline. Only colour and outline together identify the target, also from far away "
            "and at a slant."
        ),
        "clutter-choice": (
            "The pictures do not show which disc is meant; the sentence and an observation say "
            "it, so a policy has to combine the two."
        ),
        "clutter-obstacles": (
            "Posts, boxes and an overhang stand in the way and may hide the target from the eye "
            "to hand, and one of them moves at an unknown moment. Touching anything ends the "
            "episode."
        ),
    }

    certificate_passes: ClassVar[int] = 4

    def build(self, cell: "Cell") -> None:
        """Attach the target's discs and all props."""
        super().build(cell)
        self._things, self._obstacles = Things(self.spec), Obstacles(self.spec)
        self._props = Props(cell, [*self._things.stickers, *self._obstacles.props])

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up marker and props in the compiled model."""
        super().after_compile(physics)
        self._props.after_compile(physics)
        self._disc_geoms = {MARKER: self.marker_geom, **self._props.geoms}

    def draw(self, streams: Streams) -> ClutterScenario:
        """Draw target, start, what lies around, what stands around, and look."""
        spec = self.spec
        goal = self.goal_over(*self.draw_on_ring(streams.generator("target")))
        common = self.draw_common(streams, goal)
        colour = spec.colours[streams.generator("goal_colour").integers(len(spec.colours))]
        random = streams.generator("things")
        placed = self._things.lay_out(random, self.draw_on_ring, colour, goal.target[:2])
        way: FloatArray = np.zeros((0, 7))
        motion = None
        if spec.n_obstacles[1]:
            random = streams.generator("obstacles")
            way, standing = self._obstacles.draw(random, common["start"], goal)
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
            **common,
        )

    def begin(self, physics: "mjcf.Physics", scenario: ClutterScenario) -> None:
        """Put everything where it belongs, and park the rest."""
        import mujoco

        from hvs_suite.cell.prop import PARKED_M

        super().begin(physics, scenario)
        self._goal = self.goal_over(*scenario.target[:2])
        self._props.park(physics)
        self.put_marker(physics, Goal(np.array(PARKED_M), self._goal.normal))
        for each in scenario.placed:
            if each.prop == MARKER:
                self.put_marker(physics, self.goal_over(*each.pose[:2]))
            else:
                self._props.put(physics, each)
        self.marker_geom = self._disc_geoms[disc_name(scenario.colour)]
        self._obstacles.begin(physics, self._props, scenario.placed, scenario.motion)
        # The next picture shows the bodies where they were last computed.
        mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)

    def advance(self, physics: "mjcf.Physics", time_s: float) -> None:
        """Move the obstacle that moves."""
        self._obstacles.advance(physics, time_s)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return self._goal

    def observe(self, physics: "mjcf.Physics") -> dict[str, FloatArray]:
        """Which colour is meant."""
        meant = [float(colour == self.scenario.colour) for colour in self.spec.colours]
        return {GOAL_COLOUR: np.array(meant)}

    def things(self) -> list[tuple[str, FloatArray]]:
        """Colour and outline of what lies on the surface, and where (2,) m; the target first."""
        kinds = self._things.kinds
        placed = self.scenario.placed
        return [(kinds[each.prop], each.pose[:2]) for each in placed if each.prop in kinds]

    def occupied(self) -> FloatArray:
        """Where anything lies or stands."""
        return np.array([each.pose[:2] for each in self.scenario.placed])

    def obstacles(self) -> tuple["Solid", ...]:
        """All obstacles; the one that moves with all its lane until it rests."""
        return self._obstacles.present()

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
