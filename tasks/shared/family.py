"""Families of tasks: what a family has to define, and the registry of families.

A family is one class in one file. `ArmTask` plays it: arm, set points, latency, cameras, the count
of held steps and the ends of an episode are the same for all. A family adds what is in the cell,
how a scene is drawn, where the goal is, what is measured and when the task is complete.

Families of other packages are found by the entry point group ``hvs_suite.families``; see
`discover`.
"""

import abc
import dataclasses
import importlib
import importlib.metadata
import os
import warnings
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError, describe
from hvs_suite.tasks.shared.goal import UP, Goal, Keypoint, Tip
from hvs_suite.tasks.shared.scenario import Scenario, Streams, draw_look
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.solid import Solid
    from hvs_suite.cell.surface import Surface
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

ENTRY_POINTS = "hvs_suite.families"
PLUGINS = "HVS_PLUGINS"
GOAL_UNSEEN = "goal_unseen"


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far an episode has come at the end of a control step.

    Attributes:
        steps: Control steps since the reset.
        is_inside: All step bounds hold now, without collision.
        n_inside: How many control-step ends in a row they have held.
    """

    steps: int
    is_inside: bool
    n_inside: int


class Family[S: Spec, C: Scenario](abc.ABC):
    """What is special about a family; one object for each loaded environment.

    Nothing here may depend on anything but the spec, the scenario and the steps played since the
    reset: a scenario is the same wherever and whenever it is played.

    Args:
        spec: All parameters.
        named: Those that the task's name stands for; None for a task without a registered name.

    Attributes:
        spec: All parameters.
        scenario: The scenario being played; set by `begin`.
    """

    scenario: C
    certificate_passes: ClassVar[int] = 3
    """How often `certify` goes over the scenarios, for progress bars."""
    hard: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """What is hard about each of the named tasks, for its page; by name."""

    def __init__(self, spec: S, named: S | None = None) -> None:
        self.spec = spec
        self.named = named

    def surface(self) -> "Surface":
        """The work surface to build the cell on: a level table."""
        from hvs_suite.cell.surface import Surface

        return Surface()

    @abc.abstractmethod
    def build(self, cell: "Cell") -> None:
        """Attach what the family needs to the cell, before it is compiled."""

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up indices in the compiled model."""
        del physics

    @abc.abstractmethod
    def draw(self, streams: Streams) -> C:
        """Draw a scenario, as a pure function of its streams."""

    def draw_common(
        self,
        streams: Streams,
        goal: Goal,
        floor_normal: FloatArray = UP,
        solids: "tuple[Solid, ...]" = (),
    ) -> dict[str, Any]:
        """Draw start and look, to be passed on to a scenario; arguments as `start.draw_start`'s.

        Returns:
            The fields of `Scenario` itself, by name.
        """
        from hvs_suite.tasks.shared.start import draw_start

        own = self.named.start if self.named is not None else "zero"
        start = draw_start(self.spec, own, streams, goal, floor_normal, solids)
        return {"start": start, **draw_look(self.spec, streams)}

    def begin(self, physics: "mjcf.Physics", scenario: C) -> None:
        """Put the scene into its state at the reset; nothing of earlier episodes remains."""
        self.scenario = scenario

    def advance(self, physics: "mjcf.Physics", time_s: float) -> None:
        """Move what moves by itself to where it is at a time since the reset (s).

        Called at the end of each control step, before anything is measured.
        """
        del physics, time_s

    @abc.abstractmethod
    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Where the tip has to be now, or as far as that is settled, some time from now (s)."""

    @abc.abstractmethod
    def measure(self, tip: Tip) -> dict[str, float]:
        """The spec's step metrics, now."""

    def tally(
        self, physics: "mjcf.Physics", errors: Mapping[str, float], progress: Progress
    ) -> dict[str, float]:
        """The spec's episode metrics after a control step; called once for each.

        Here the scene may change by what was achieved, such as a target that vanishes.

        Args:
            physics: The compiled cell.
            errors: Step metrics at the end of the control step.
            progress: How far the episode has come.
        """
        return {}

    def at_reset(self) -> dict[str, float]:
        """The spec's episode metrics before the first control step."""
        return {}

    @abc.abstractmethod
    def keypoints(self) -> dict[str, Keypoint]:
        """The spec's keypoints, where they are now."""

    def is_complete(self, progress: Progress) -> bool:
        """Whether the task has been done: all step bounds held for ``hold_steps`` in a row."""
        return progress.n_inside >= self.spec.hold_steps

    def steps_to_goal(self, progress: Progress) -> int:
        """Control steps to the goal, asked when it is complete."""
        return progress.steps

    def is_over(self, progress: Progress) -> bool:
        """Whether the episode ends without success before the time limit, because time is up."""
        return False

    def is_forbidden(self, physics: "mjcf.Physics") -> bool:
        """Whether what is touched now must never be.

        Asked after every physics step before or after which anything touched anything.
        """
        return bool(physics.data.ptr.ncon)

    def observe(self, physics: "mjcf.Physics") -> dict[str, FloatArray]:
        """The spec's further observations, now, by name."""
        return {}

    def obstacles(self) -> "tuple[Solid, ...]":
        """What the arm must keep out of beside the surface; of what moves, all that it sweeps."""
        return ()

    def occupied(self) -> FloatArray:
        """Places where something lies or comes in this scene, (n, 2) m, base frame.

        What a study strews over the table keeps away from them.
        """
        return self.goal().target[None, :2]

    def privileged(self) -> dict[str, FloatArray]:
        """Further values that only training and the expert may see, by name.

        Under `GOAL_UNSEEN`, how far the goal is from where the pictures show it, (3,) m, base
        frame: demonstrations go where it is shown.
        """
        return {}

    @classmethod
    @abc.abstractmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Certificate lines that need no rollouts.

        Args:
            env: A named task on its test split.
            scenarios: Indices to check; gone over once for each group of checks.
        """


@dataclasses.dataclass(frozen=True)
class Registered:
    """A named task.

    Attributes:
        spec: What its name stands for.
        family: Class that plays it.
    """

    spec: Spec
    family: type[Family[Any, Any]]


_registered: dict[str, Registered] = {}


def register(family: type[Family[Any, Any]], *specs: Spec) -> None:
    """Make named tasks known.

    Args:
        family: Class that plays them.
        specs: One for each name.

    Raises:
        OptionError: A name does not begin with its family's, or is taken.
    """
    for spec in specs:
        if not spec.name.startswith(f"{spec.family}-"):
            raise OptionError(
                f"a task of family {spec.family} is called {spec.family}-..., not {spec.name!r}"
            )
        known = _registered.get(spec.name)
        if known is not None and known != Registered(spec, family):
            raise OptionError(f"there is another task called {spec.name!r}; choose another name")
        _registered[spec.name] = Registered(spec, family)


def registered() -> Mapping[str, Registered]:
    """All named tasks, in the order in which they were registered."""
    return MappingProxyType(_registered)


def discover() -> None:
    """Import the families of other packages, which register their tasks.

    An installed package names its modules in the entry point group ``hvs_suite.families``; modules
    to try are named, separated by commas, in the environment variable ``HVS_PLUGINS``, which worker
    processes inherit. A module that cannot be imported gives a warning, because the suite's own
    tasks do not need it.
    """
    modules = [entry.value for entry in importlib.metadata.entry_points(group=ENTRY_POINTS)]
    modules += filter(None, os.environ.get(PLUGINS, "").split(","))
    for module in modules:
        try:
            import_family(module)
        except OptionError as error:
            warnings.warn(f"{error}; its tasks are missing", stacklevel=2)


def import_family(module: str) -> None:
    """Import a module that registers tasks.

    Raises:
        OptionError: It cannot be imported.
    """
    try:
        # Such modules import dm_control at the top; the OpenGL backend has to be chosen before
        # that.
        importlib.import_module("hvs_suite.cell")
        importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a foreign module may raise anything
        raise OptionError(f"cannot import the tasks of {module}: {describe(error)}") from error
