"""``sequence``: reach one target after another, each within a time of its own.

The thesis's full task. Targets lie on the ring, one at a time. A target vanishes when it was
reached, or when its time is up, which does not end the episode; the next appears elsewhere. Success
is to have reached them all. The difficulty is that the target vanishes at once: a policy has to
notice this, forget the old place and find the new one, which the arm may hide from both cameras.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.family import Progress, register
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.metric import Metric
from hvs_suite.tasks.shared.placing import HARD, Placing, PlacingSpec
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import Description, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

MISSED = "missed_targets"
_MAX_REDRAWS = 1000


@dataclasses.dataclass(frozen=True, kw_only=True)
class SequenceSpec(PlacingSpec):
    """Every parameter of ``sequence``; the tolerances are those of each target.

    Attributes:
        n_targets: Targets of an episode.
        target_steps: Control steps that a target stays.
        target_distance_m: Least distance from a target to the next (m).
    """

    family: ClassVar[str] = "sequence"
    headline: ClassVar[tuple[str, ...]] = (MISSED,)
    plays_on: ClassVar[bool] = False

    n_targets: int = scene(5)
    target_steps: int = 30
    target_distance_m: float = scene(0.20)
    time_limit_steps: int = 150

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check("must be at least 1", lambda value: value >= 1, "n_targets", "target_steps")
        if self.n_targets * self.target_steps > self.time_limit_steps:
            raise OptionError(
                f"{self.n_targets} targets of {self.target_steps} steps do not fit into "
                f"time_limit_steps {self.time_limit_steps}; raise it, or show fewer or shorter"
            )
        if not 0.0 <= self.target_distance_m <= self.ring_m[1]:
            raise OptionError(
                f"target_distance_m is {self.target_distance_m}; use 0 to the ring's outer radius "
                f"of {self.ring_m[1]} m"
            )

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The errors to the present target, and how many targets have not been reached."""
        return (*super().metrics, Metric(MISSED, "", "targets missed", 0.0, over="episode"))

    def instruction(self, scenario: Scenario | None = None) -> str:
        """The task as one sentence."""
        return (
            "Place the flange centred over one target after the other, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface."
        )

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        return dataclasses.replace(
            words,
            target=f"{self.n_targets} in turn, {self.target_steps} steps each, {words.target}",
        )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class SequenceScenario(Scenario):
    """One scene.

    Attributes:
        targets: Centres of the targets in their order, (n, 3) m, base frame.
    """

    targets: FloatArray


class Sequence(Placing[SequenceSpec, SequenceScenario]):
    """Targets that appear one after the other."""

    hard: ClassVar[Mapping[str, str]] = {
        "sequence-thesis": (
            "Each target vanishes when it was reached or when its time is up, and the next may "
            "lie half a turn around the base: five ways in a row have to succeed, each from "
            "wherever the arm is."
        ),
        "sequence-hard": (
            "There is time for the way and for one look from above, but not for two. The eye to "
            "hand has an error of up to ten centimetres on the table; the first target shows "
            "this error, and a policy could use it for the next four."
        ),
    }

    def draw(self, streams: Streams) -> SequenceScenario:
        """Draw targets, start and look."""
        targets = self._draw_targets(streams)
        first = self.goal_over(*targets[0, :2])
        return SequenceScenario(targets=targets, **self.draw_common(streams, first))

    def _draw_targets(self, streams: Streams) -> FloatArray:
        places: list[tuple[float, float]] = []
        for i in range(self.spec.n_targets):
            random = streams.generator(f"target-{i}")
            for _ in range(_MAX_REDRAWS):
                place = self.draw_on_ring(random)
                if not places or np.hypot(*np.subtract(place, places[-1])) >= (
                    self.spec.target_distance_m
                ):
                    break
            else:
                raise OptionError(
                    f"no target found {self.spec.target_distance_m} m away from the last one; "
                    "lower target_distance_m"
                )
            places.append(place)
        return np.column_stack([places, np.zeros(len(places))])

    def begin(self, physics: "mjcf.Physics", scenario: SequenceScenario) -> None:
        """Show the first target."""
        super().begin(physics, scenario)
        self._n_reached = 0
        self._show(physics, 0)

    def _show(self, physics: "mjcf.Physics", number: int) -> None:
        """Let the present target vanish and target ``number`` appear, if there is one."""
        self._number, self._steps_shown, self._steps_held = number, 0, 0
        if number < self.spec.n_targets:
            self._goal = dataclasses.replace(
                self.goal_over(*self.scenario.targets[number, :2]),
                more_follow=number + 1 < self.spec.n_targets,
            )
            self.put_marker(physics, self._goal)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the present target; the place of the next one is not known."""
        return self._goal

    def occupied(self) -> FloatArray:
        """Where targets are, now or later."""
        return self.scenario.targets[:, :2]

    def at_reset(self) -> dict[str, float]:
        """None has been reached."""
        return {MISSED: float(self.spec.n_targets)}

    def tally(
        self, physics: "mjcf.Physics", errors: Mapping[str, float], progress: Progress
    ) -> dict[str, float]:
        """Count the targets, and show the next one where the present one's time is over."""
        self._steps_shown += 1
        self._steps_held = self._steps_held + 1 if progress.is_inside else 0
        is_reached = self._steps_held >= self.spec.hold_steps
        self._n_reached += is_reached
        if is_reached or self._steps_shown >= self.spec.target_steps:
            self._show(physics, self._number + 1)
        return {MISSED: float(self.spec.n_targets - self._n_reached)}

    def is_complete(self, progress: Progress) -> bool:
        """Whether all have been reached."""
        return self._n_reached == self.spec.n_targets

    def is_over(self, progress: Progress) -> bool:
        """Whether the last target is gone."""
        return self._number == self.spec.n_targets

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Each target reachable and in time from the one before; observable and accurate."""
        from hvs_suite.tasks.shared import certificate

        return [
            *certificate.check_legs(
                env, scenarios, lambda scenario: scenario.targets, env.task.family.spec.target_steps
            ),
            *certificate.check_visibility(env, scenarios),
            *certificate.check_accuracy(env, scenarios),
        ]


_THESIS = SequenceSpec(
    name="sequence-thesis",
    # The arm may half cover a target: at 112 px two pixels would be left of it.
    eth_resolution=168,
)

register(
    Sequence,
    _THESIS,
    dataclasses.replace(
        _THESIS,
        name="sequence-hard",
        start="random",
        target_diameter_m=0.020,
        position_tolerance_mm=None,
        lateral_tolerance_mm=0.25,
        height_tolerance_mm=1.0,
        tilt_tolerance_deg=0.4,
        hold_steps=5,
        # The expert's slowest way takes 30, half around the base.
        target_steps=31,
        time_limit_steps=155,
        joint_offset_deg=0.05,
        latency_steps=1,
        **{
            **HARD,
            # Twice what the others have: 2 cm and 2 deg at most, 10 cm on the table. What one
            # target shows of it serves for the next.
            "eth_position_noise_m": 0.01,
            "eth_rotation_noise_deg": 1.0,
            "eth_fov_deg": 35.0,
        },
    ),
)
