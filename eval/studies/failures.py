"""Why a policy fails: every lost scenario of a result, played again and sorted by its cause.

The causes need different remedies. A target that was never seen needs better looking, one that was
seen but misplaced, or whose slope was misjudged, needs a better eye, and one that was known well
but not reached needs better control or more speed.
"""

import contextlib
import dataclasses
import enum
import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from hvs_suite import registry
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.errors import ResultError
from hvs_suite.eval.scoring import result_file, verification
from hvs_suite.eval.scoring.result_file import EpisodeRow
from hvs_suite.eval.scoring.trial import play_trial
from hvs_suite.names import shown
from hvs_suite.policies.belief.belief import PLACE
from hvs_suite.policies.belief.geometry import flange_motion
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import load_network, network_inputs
from hvs_suite.rollout import Action, Observation, one_torch_thread
from hvs_suite.tasks.shared.goal import TILT
from hvs_suite.tasks.shared.option_types import listed
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

# An error that falls by a fifth in so many steps is on its way to the goal.
_LAST_STEPS = 3
_FALLING = 0.8


class Cause(enum.StrEnum):
    """Why a scenario was lost; the first that applies, in this order."""

    BROKEN = "the policy broke down"
    COLLIDED = "collided"
    OVERLOADED = "pressed too hard"
    NOT_SEEN = "target not seen"
    MISPLACED = "seen but misplaced"
    MISJUDGED = "slope misjudged"
    SLOW = "too slow"
    CONTROLLED = "controlled badly"


@dataclasses.dataclass(frozen=True)
class Estimate:
    """How far off a policy was at its last decision, in the flange's frame.

    Where the joints measure wrongly it need not know where in the room flange and target stand.

    Attributes:
        place_mm: From where the target was to where the policy took it to be, sideways (mm).
        slope_deg: Between the surface's normal there and the believed one (deg).
    """

    place_mm: float
    slope_deg: float


@dataclasses.dataclass(frozen=True)
class Failure:
    """One lost scenario.

    Attributes:
        scenario: Its index.
        cause: Why it was lost.
        steps: Control steps played.
        errors: The task's metrics at the end.
        seen_steps: Decisions at which a camera had the target in view.
        off: How far off the policy was. None where it does not say.
        target_radius_m: Distance of the target from the base's axis (m).
    """

    scenario: int
    cause: Cause
    steps: int
    errors: Mapping[str, float]
    seen_steps: int
    off: Estimate | None
    target_radius_m: float


@dataclasses.dataclass(frozen=True)
class Report:
    """The failures of one result.

    Attributes:
        task: Named task.
        options: Options that changed it.
        policy: Its name.
        split: Split.
        n_episodes: Scenarios played.
        failures: The lost ones, by scenario.
    """

    task: str
    options: Mapping[str, Any]
    policy: str
    split: str
    n_episodes: int
    failures: tuple[Failure, ...]

    def of(self, cause: Cause) -> tuple[Failure, ...]:
        """The failures of one cause."""
        return tuple(failure for failure in self.failures if failure.cause is cause)


class LoggedPolicy:
    """Plays a scenario's logged actions, whatever it is shown.

    Args:
        actions: (steps, 7) float32.
    """

    def __init__(self, actions: Sequence[Action]) -> None:
        self._actions = actions
        self._remaining: Iterator[Action] = iter(())

    def reset(self) -> None:
        """From the first action on."""
        self._remaining = iter(self._actions)

    def select_action(self, observation: Observation) -> Action:
        """The next action."""
        return next(self._remaining)


def sort_failures(
    path: Path, checkpoint: Path | None = None, progress: Callable[[], None] | None = None
) -> Report:
    """Play every lost scenario of a result again and find out why it was lost.

    Args:
        path: The result; its action log stands beside it.
        checkpoint: The `hvs` policy that made it, to ask where it took the target to be; None where
            there is none, and then nothing counts as misplaced or misjudged.
        progress: Called after each lost scenario.

    Returns:
        The failures.

    Raises:
        ResultError: The result or its log is damaged.
        PolicyError: The checkpoint is not of an `hvs` policy, or cannot be loaded.
    """
    result = result_file.load(path)
    log = verification.load_actions(path, result)
    asked = (
        None if checkpoint is None else _Asked(load_network(checkpoint), read_config(checkpoint))
    )
    failures = []
    summary, options = result.summary, result.metadata.options
    with contextlib.closing(registry.load(summary.task, split=summary.split, **options)) as env:
        unlogged = None
        if result.metadata.n_logged < len(result.episodes):
            unlogged = verification.named_policy(path, result).make(env)
        for row in result.episodes:
            if row.success:
                continue
            if row.scenario < len(log):
                actions = log[row.scenario]
            else:
                assert unlogged is not None
                _, actions = play_trial(env, unlogged.reset, unlogged.select_action, row.scenario)
            failures.append(_sort(env, row, list(actions[: row.steps]), asked))
            if progress is not None:
                progress()
    return Report(
        summary.task, options, summary.policy, summary.split, summary.n_episodes, tuple(failures)
    )


class _Asked:
    """A network that is asked, at every step of an episode, where it takes the target to be."""

    def __init__(self, network: BeliefNetwork, config: Mapping[str, Any]) -> None:
        self._network, self._config = network, config
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self._memory = self._network.start(1)

    def target_at_flange(self, observation: Observation) -> tuple[FloatArray, FloatArray]:
        """Believed target (3,) m and normal (3,) in the frame of the flange as it is measured."""
        network = self._network
        inputs = network_inputs(network, self._config, observation)
        q = inputs.state[:, :N_JOINTS]
        with torch.inference_mode(), one_torch_thread():
            sightings = network.look(inputs.images, inputs.goal)
            self._memory = network.remember(self._memory, sightings, q)
            flange = flange_motion(q.double())
            way = self._memory[:, PLACE] - flange.position
            seen = torch.stack([way, network.belief.normal(self._memory)], dim=1) @ flange.rotation
        place, normal = seen[0].numpy()
        return place, normal

    def remember(self, action: Action) -> None:
        """Where the arm was sent."""
        with torch.inference_mode(), one_torch_thread():
            self._memory = self._network.commanded(self._memory, torch.from_numpy(action)[None])


def _sort(
    env: "Environment", row: EpisodeRow, actions: Sequence[Action], asked: "_Asked | None"
) -> Failure:
    """Play one lost scenario and say why it was lost."""
    time_step = env.reset(scenario=row.scenario)
    target = np.asarray(env.privileged()["target_position"])
    if asked is not None:
        asked.reset()
    off: Estimate | None = None
    seen = 0
    distances_m = [env.distance_m]
    spec = env.action_spec()
    for action in actions:
        if time_step.last():
            raise ResultError(f"the log of scenario {row.scenario} goes on after its end")
        truth = env.privileged()
        seen += any(truth[f"target_{camera}"][3] > 0.5 for camera in ("eih", "eth"))
        executed = np.clip(action, spec.minimum, spec.maximum).astype(np.float32)
        if asked is not None:
            rotation, flange = kinematics().flange_pose(env.joint_positions)
            place, normal = asked.target_at_flange(time_step.observation)
            beside = rotation @ place - (np.asarray(truth["target_position"]) - flange)
            leaning = float(np.dot(rotation @ normal, truth["goal_normal"]))
            off = Estimate(
                place_mm=1e3 * float(np.linalg.norm(beside[:2])),
                slope_deg=math.degrees(math.acos(min(max(leaning, -1.0), 1.0))),
            )
            asked.remember(executed)
        time_step = env.step(executed)
        distances_m.append(env.distance_m)
    return Failure(
        scenario=row.scenario,
        cause=cause_of(row, env.spec, seen, off, distances_m),
        steps=row.steps,
        errors=row.errors,
        seen_steps=seen,
        off=off,
        target_radius_m=float(np.hypot(target[0], target[1])),
    )


def cause_of(
    row: EpisodeRow,
    spec: Spec,
    seen_steps: int,
    off: Estimate | None,
    distances_m: Sequence[float],
) -> Cause:
    """Why a scenario was lost.

    Args:
        row: Its outcome.
        spec: The task's parameters.
        seen_steps: As in `Failure`.
        off: As in `Failure`.
        distances_m: Distance to the goal at the start and after every step (m).
    """
    if row.failure is not None:
        return Cause.BROKEN
    if row.collision:
        return Cause.OVERLOADED if spec.is_overload(row.errors) else Cause.COLLIDED
    if not seen_steps:
        return Cause.NOT_SEEN
    if off is not None and off.place_mm > spec.tightest_tolerance_mm:
        return Cause.MISPLACED
    if off is not None and off.slope_deg > spec.step_bounds.get(TILT, math.inf):
        return Cause.MISJUDGED
    if distances_m[-1] < _FALLING * distances_m[-1 - min(_LAST_STEPS, len(distances_m) - 1)]:
        return Cause.SLOW
    return Cause.CONTROLLED


def markdown(reports: Sequence[Report]) -> str:
    """A table of causes for each result, and the scenarios behind it.

    Args:
        reports: One a result.
    """
    lines = []
    for report in reports:
        counts = Counter(failure.cause for failure in report.failures)
        changed = f" with `{shown(listed(report.options))}`" if report.options else ""
        lines += [
            f"`{shown(report.policy)}` on `{report.task}`{changed}, split `{report.split}`: "
            f"{len(report.failures)} of {report.n_episodes} lost.",
            "",
        ]
        if not report.failures:
            continue
        headline = registry.find(report.task).headline[0]
        lines += [
            f"| cause | lost | share | median {headline} | median error of the estimate, mm "
            "| and of the slope, deg | median radius of the target, m | scenarios |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for cause in Cause:
            if not counts[cause]:
                continue
            found = report.of(cause)
            off = [failure.off for failure in found if failure.off is not None]
            place, slope = (
                f"{statistics.median(values):.2f}" if values else "-"
                for values in ([each.place_mm for each in off], [each.slope_deg for each in off])
            )
            scenarios = ", ".join(str(failure.scenario) for failure in found[:8])
            lines.append(
                f"| {cause} | {len(found)} | {100 * len(found) / report.n_episodes:.1f} % | "
                f"{statistics.median(f.errors[headline] for f in found):.2f} | "
                f"{place} | {slope} | "
                f"{statistics.median(f.target_radius_m for f in found):.2f} | "
                f"{scenarios}{', ...' if len(found) > 8 else ''} |"
            )
        lines.append("")
    return "\n".join(lines)
