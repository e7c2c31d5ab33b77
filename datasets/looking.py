"""The demonstrator: the expert, except that it looks for the target before it goes there.

The expert knows where the target is. If the arm hides the target from both cameras, a policy that
learns from the expert does not know it, and the mean of the ways to all possible places leads
nowhere. So as long as no camera has seen the target, the demonstrator moves the arm out of the
eye-to-hand camera's line of sight, always to the same posture. If an obstacle hides the target even
then, the eye in hand looks down all around the base.

If the pose of the eye-to-hand camera is not exact, it locates the target only within some
centimetres. An arm that goes there at once ends up beside the target, too low for the eye in hand
to see it. So until the eye in hand has seen the target, the demonstrator heads for a place above
it, from which the eye in hand can see it. Above a target that moves, it moves along. If no camera
sees it from there, the eye-to-hand camera saw too little of it, and it looks again.

A target that is suddenly elsewhere counts as a new one that has not been seen. But of each that
both cameras have seen, more is known of how the eye-to-hand camera is shifted and turned: over the
second target the demonstrator looks from lower, and to those that follow it goes straight.

It goes there in a plain posture, by the rule by which the policy's head is shown one (see
`hvs_suite.cell.plain_postures`).

Among obstacles it comes from above, as a policy can that does not see them (see
`hvs_suite.datasets.flyover`).

Over a surface of unknown slope it goes around, or leans, on its way down, so that the eye in the
hand sees the slope (see `hvs_suite.datasets.leaning`).

Into a hole it goes down along a funnel (see `hvs_suite.datasets.insertion`). Where the hole is not
where the pictures show it, nobody sees that, so it goes where they show it, and presses gently.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets import flyover
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.leaning import Straightening, raised, way_down
from hvs_suite.datasets.planner import Planner
from hvs_suite.tasks.shared.family import GOAL_UNSEEN
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.panels import PanelSpec
from hvs_suite.tasks.shared.peg_and_bushing import WRENCH, PegSpec
from hvs_suite.tasks.shared.spec import CAMERA_NAMES

if TYPE_CHECKING:
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

LOOK_OUT_RAD: FloatArray = np.array([1.75, 0.8, 0.0, -0.6, 0.0, 0.6, 0.0])
"""Where the arm goes to look (rad), chosen for the fewest steps (docs/experiments/look-out.md)."""
LOOK_AROUND_RAD: FloatArray = np.array(
    [[2.4, 0.26, 0.0, -1.44, 0.0, 1.44, 0.0], [-2.7, 0.26, 0.0, -1.44, 0.0, 1.44, 0.0]]
)
"""Where it goes from there, one after the other (rad): the flange looks down from a height of
0.55 m, which clears all obstacles, and passes over the whole ring."""
LOOK_DOWN_M = (0.15, 0.05)
"""How far above the goal the eye in the hand looks for the first and for the second target (m):
high enough to have it in view wherever the eye-to-hand camera may take it to be, and hardly a
detour. What one target says of that camera leaves 35 mm in 49 of 50 scenes of ``sequence-hard``,
what two say 8 mm."""
AT_REST_RAD_S = 0.05
"""Slower than this the arm has arrived (rad/s)."""
CLEARANCE_M = 0.03
"""What demonstrations keep from surface, self and obstacles where they can (m): what imitates a way
that passes at 10 mm touches, some of the time."""
_THERE_RAD = 0.02
_NOTHING: FloatArray = np.zeros(3)


class Demonstrator(Expert):
    """Answers with the action that a policy should learn; one episode at a time.

    Args:
        env: Where it acts.
    """

    def __init__(self, env: Environment) -> None:
        spec = env.spec
        super().__init__(env, plain=True, clearance_m=CLEARANCE_M)
        # Leaning to all sides, the wrist of a plain posture would have to turn over.
        self._near_planner = Planner(
            self._period_s, embodiment=spec.embodiment, clearance_m=CLEARANCE_M
        )
        self._looks_down = spec.eth_position_noise_m > 0 or spec.eth_rotation_noise_deg > 0
        self._way: tuple[tuple[Solid, ...], bytes] = (), b""
        self._is_way_free = False
        self.reset()

    def reset(self) -> None:
        """Forget what was seen: a new episode begins."""
        self._n_compared = 0 if self._looks_down else len(LOOK_DOWN_M)
        self._begin_target(None)

    def _begin_target(self, target: FloatArray | None) -> None:
        self._target = target
        self._seen_by: set[str] = set()
        self._n_looked = 0

    @property
    def _has_seen_closely(self) -> bool:
        """Whether it is known exactly enough where the target is to go there."""
        return self._knows_far_camera or "eih" in self._seen_by

    @property
    def _knows_far_camera(self) -> bool:
        """Whether it is known how the eye-to-hand camera is shifted and turned."""
        return self._n_compared == len(LOOK_DOWN_M)

    def _next_set_point(
        self, q: FloatArray, velocity: FloatArray, set_point: FloatArray
    ) -> FloatArray:
        goal = self._env.goal()
        if self._target is not None and not _is_same(self._target, goal):
            self._begin_target(goal.target)
        self._target = goal.target
        if not (self._seen_by and self._knows_far_camera):
            self._look()
        if not self._seen_by:
            ahead = self._planner.towards_posture(q, velocity, self._next_look(q))
            if ahead is not None:
                return ahead
        if self._flies_over() and flyover.is_low(self._env.goal(), self._env.tip()):
            ahead = self._planner.towards_posture(q, velocity, flyover.UPRIGHT_RAD)
            if ahead is not None:
                return ahead
        spec, goal = self._env.spec, self._goal_in(0.0)
        if isinstance(spec, PegSpec) and goal.standoff_m < 0.0:
            pressed_n = -float(self._env.privileged()[WRENCH][2]) if self._unseen().any() else None
            return self._insertion.learnable_set_point(
                q, velocity, set_point, goal, spec.caught_mm, pressed_n=pressed_n
            )
        if isinstance(spec, PanelSpec) and self._has_seen_closely:
            way = way_down(spec)
            steps_left = spec.time_limit_steps - spec.hold_steps - self._env.control_steps
            around, is_near = way.next_place(goal, self._env.tip(), q, steps_left)
            planner = self._near_planner if is_near else self._planner
            planner.avoid(self._env.obstacles)
            ahead = planner.next_set_point(q, velocity, around)
            if is_near and around is not goal and isinstance(way, Straightening):
                ahead[-1] = way.turned(set_point[-1], steps_left)
            return ahead
        return super()._next_set_point(q, velocity, set_point)

    def _goal_in(self, ahead_s: float) -> Goal:
        goal = super()._goal_in(ahead_s)
        goal = dataclasses.replace(goal, target=goal.target - self._unseen())
        if self._flies_over():
            over = flyover.next_place(goal, self._env.tip())
            if over is not goal:
                return over
        if self._has_seen_closely:
            return goal
        spec, height = self._env.spec, LOOK_DOWN_M[self._n_compared]
        if isinstance(spec, PanelSpec):
            return way_down(spec).above(goal, height)
        return raised(goal, height)

    def _flies_over(self) -> bool:
        """Whether something may stand around, and the way over it is free."""
        if not flyover.leads_over(self._env.spec):
            return False
        solids, goal = self._env.obstacles, self._env.goal()
        key = solids, goal.position.tobytes()
        if key != self._way:
            self._way = key
            over = raised(goal, flyover.OVER_M)
            self._is_way_free = self._planner.is_free_by(flyover.UPRIGHT_RAD, over, goal)
        return self._is_way_free

    def _unseen(self) -> FloatArray:
        """How far the goal is from where the pictures show it, (3,) m."""
        return self._env.privileged().get(GOAL_UNSEEN, _NOTHING)

    def _next_look(self, q: FloatArray) -> FloatArray:
        """Where to look from next, (7,) rad: from where the arm has come, it has looked."""
        looks = [LOOK_OUT_RAD, *LOOK_AROUND_RAD]
        if self._n_looked < len(looks) - 1 and np.abs(q - looks[self._n_looked]).max() < _THERE_RAD:
            self._n_looked += 1
        return np.asarray(looks[self._n_looked])

    def _look(self) -> None:
        """Notice which cameras have the target in view."""
        truth, [target, *_] = self._env.privileged(), self._env.spec.keypoints
        seen = {name for name in CAMERA_NAMES if truth[f"{target}_{name}"][3] > 0.5}
        if "eih" not in seen and not self._has_seen_closely and self._waits_above():
            self._seen_by.clear()
        compared = self._seen_by.issuperset(CAMERA_NAMES)
        self._seen_by |= seen
        if self._seen_by.issuperset(CAMERA_NAMES) and not compared:
            self._n_compared = min(self._n_compared + 1, len(LOOK_DOWN_M))

    def _waits_above(self) -> bool:
        """Whether the arm rests as high as where the eye in the hand looks from, or higher.

        One that rests lower has only to go up.
        """
        goal = self._env.goal()
        height = goal.normal @ (self._env.tip().position - goal.position)
        rests = np.abs(self._env.joint_velocities).max() < AT_REST_RAD_S
        return bool(rests and height > 0.8 * LOOK_DOWN_M[self._n_compared])


def _is_same(target: FloatArray, goal: Goal) -> bool:
    """Whether the target of a goal is the one that was at a place (3,) a control step ago.

    One that moves may be anywhere near by; one that does not has to be there still.
    """
    return bool(goal.velocity.any() or (goal.target == target).all())


def make_demonstrator(env: Environment) -> Demonstrator:
    """The demonstrator for an environment; a :data:`hvs_suite.rollout.PolicyFactory`."""
    return Demonstrator(env)
