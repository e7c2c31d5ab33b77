"""The visuomotor network: eyes, a belief, and a head that turns it into a joint step.

What it knows beforehand is the cell: the arm's kinematics and the cameras' nominal places. What a
task is (where targets lie, how large they are, how far off the tool stays, what comes first) it
learns from demonstrations.

The head thinks in the goal's frame first: a small network says to which point by the goal the tip
should go next, damped least squares turn that into a joint step. The ways to plain postures
over the goal, and to one from which the cameras see more, are put beside it. A second network
weighs them and corrects their mean, on a logarithmic scale on which a micrometre and a metre both
teach something.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from hvs_suite.cell.plain_postures import CHOSEN_ABOVE_M
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, LAG_S
from hvs_suite.policies.belief import arm, geometry
from hvs_suite.policies.belief.belief import (
    ACCELERATION,
    BELIEF_SIZE,
    COVARIANCE,
    N_MOTION,
    PLACE,
    TILT_VARIANCE,
    VELOCITY,
    Belief,
    Prior,
    Ray,
    View,
)
from hvs_suite.policies.belief.choice import Choice
from hvs_suite.policies.belief.colour_slope import ColourSlopeEye
from hvs_suite.policies.belief.eye import LOG_DIAMETER, UV, VISIBLE, Eye, Seen
from hvs_suite.policies.belief.foresight import Foresight
from hvs_suite.policies.belief.geometry import FlangeMotion
from hvs_suite.policies.belief.residual import RESIDUAL_SIZE, SHIFT, Residual, goal_axes
from hvs_suite.policies.belief.slope import SlopeEye

N_JOINTS = 7
ACTION_UNITS = 2.0**20
"""Actions are multiples of one part of these; so the action log keeps them in little space."""
OUT_BOUNDS = (6.0, 8.0, 6.0)
"""Of the correction, its gate and the weights of the proposals. Without them a head that is right
nearly always grows so sure that what it should learn of the rest changes nothing any more."""
HEIGHTS_M = (0.0, 0.05, 0.15)
"""Above the goal, along its normal: the plain postures that the head is shown."""
MOST_LEAN = 1.0
"""Tangent of the angle by which the head may let the tool lean to a side."""
LEAN_SCALE = 0.01
"""Tangents below this are said linearly, those above logarithmically, where slopes are to be seen:
from the side a degree does not matter, and at the goal a third of one does."""
SURE = 3.0
"""By which the weights of the proposals are multiplied where some of them lean: a tenth of the way
to one of these would end a millimetre beside the goal."""
MOST_KEPT = 2.0
"""By what factor it may at most have the tool go on leaning as it does."""
ARRIVES_LEANING = math.tan(math.radians(33.0))
LEANING_HEIGHTS_M = (0.006, 0.15)
"""Where slopes are to be seen, the head is also shown plain postures that lean away from the base,
by this tangent, and stand so far above the goal. Demonstrations that look from the side come down
so (`hvs_suite.datasets.leaning.Straightening`)."""
RECENT_SIZE = 4
"""What is remembered beside belief and set point: for how long each camera has not seen the target
(two), and a trace of what was forgotten (two)."""


@dataclasses.dataclass(frozen=True)
class CellModel:
    """The cell as it is drawn up, known to any policy.

    Attributes:
        period_s: Control period (s).
        latency_steps: Control steps between an action and its effect.
        lead_s: How far a set point runs ahead of the joints on a way (s).
        tool_length_m: From the flange to the tip (m).
        tan: Camera name to the tangent of half its field of view.
        eth_origin: Nominal place of the eye to hand, (3,) m.
        eth_rotation: Its optical axes as columns, (3, 3).
        eih_origin: Place of the eye in the hand in the flange frame, (3,) m.
        eih_rotation: Its optical axes there as columns, (3, 3).
        look_out_rad: Posture in which the arm hides nothing from the eye to hand, (7,) rad; None
            for a head that is not shown the way there.
        over_m: From how far above the goal the arm comes down where something stands around (m):
            the head is shown the plain posture there, and the way to the upright arm. None where
            nothing does.
    """

    period_s: float
    latency_steps: int
    lead_s: float
    tool_length_m: float
    tan: Mapping[str, float]
    eth_origin: tuple[float, ...]
    eth_rotation: tuple[tuple[float, ...], ...]
    eih_origin: tuple[float, ...]
    eih_rotation: tuple[tuple[float, ...], ...]
    look_out_rad: tuple[float, ...] | None = None
    over_m: float | None = None


@dataclasses.dataclass(frozen=True)
class Shape:
    """Sizes that decide which weights there are.

    Attributes:
        cameras: Name (``eih``, ``eth``) to (channels, side in px).
        n_goals: Length of the one-hot that says which target is meant; 0 for none.
        n_felt: Length of the wrench; 0 for none.
        channels: Channels of the eyes.
        hidden: Width of the head.
        error_scale: Below it errors weigh linearly, above logarithmically: joint steps (rad) and
            places (m).
        residual_hidden: Width of the residual; 0 for none.
        residual_step_m: The most that it moves the goal in a step: sideways, and along the normal
            (m).
        residual_reach_m: How far from the believed goal the tip may be for the goal to be moved
            (m).
        choice_beyond_m: How far from the believed goal what policy search has found shifts the
            choice among the proposals (m); None without it.
        reads_positions: Whether measured joint positions are read; without them the network knows
            where the arm starts, and from there on where it has sent it.
        reads_velocities: Whether measured joint velocities are read; without them the network
            knows how far the arm trails where it has been sent.
        slopes: Cameras whose eyes tell slopes. With any, the head may let the tool lean about the
            target.
        slopes_by: What they tell them by: moments of the picture's ``contrasts``
            (`hvs_suite.policies.belief.slope`), or the shape of what has the target's ``colour``
            (`hvs_suite.policies.belief.colour_slope`).
        offsets: Cameras whose pose is not exact, and of which the belief finds out how they are
            shifted and turned.
        foresight: Control steps of which it remembers where the target was, to say where it will be
            (`hvs_suite.policies.belief.foresight`); with 0, it takes the believed acceleration to
            last.
        remembers: Whether it remembers what it has seen; without, each observation is like the
            first, but for where the arm has been sent.
        corrects_within_m: How far from the believed goal the head corrects the mean of its
            proposals (m); beyond it does so less, and from twice as far on not at all. None where
            it does so everywhere: what it has learned near the goal may then hold an arm still that
            is far away (docs/experiments/standing-still.md).
        elbow_aside: Whether the plain postures that the head is shown may have the elbow to a side,
            as those of `hvs_suite.cell.plain_postures`. Older weights know it straight above alone.
    """

    cameras: Mapping[str, tuple[int, int]]
    n_goals: int = 0
    n_felt: int = 0
    channels: int = 32
    hidden: int = 256
    error_scale: float = 0.005
    residual_hidden: int = 0
    residual_step_m: tuple[float, float] = (0.0004, 0.001)
    residual_reach_m: float = 0.02
    choice_beyond_m: float | None = None
    reads_positions: bool = True
    reads_velocities: bool = True
    slopes: tuple[str, ...] = ()
    slopes_by: Literal["contrasts", "colour"] = "contrasts"
    offsets: tuple[str, ...] = ()
    foresight: int = 0
    remembers: bool = True
    corrects_within_m: float | None = None
    elbow_aside: bool = True


MEMORY_SIZE = BELIEF_SIZE + 2 * N_JOINTS + 2 + RECENT_SIZE
SET_POINT = slice(BELIEF_SIZE, BELIEF_SIZE + N_JOINTS)
TRAILING = slice(SET_POINT.stop, SET_POINT.stop + N_JOINTS)
"""Where the joints will be when they have been sent to the set point for a control step."""
BEGUN = slice(TRAILING.stop, TRAILING.stop + 1)
STEPS = slice(BEGUN.stop, BEGUN.stop + 1)
"""How many observations there have been."""
RECENT = slice(STEPS.stop, MEMORY_SIZE)
FELT = slice(MEMORY_SIZE, MEMORY_SIZE + RESIDUAL_SIZE)
"""Where what the residual remembers stands, in networks that have one."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Place:
    """The tip, measured and as it was sent, and where its goal is taken to be (m)."""

    here: FlangeMotion
    sent: FlangeMotion
    goal: Tensor
    normal: Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Decision:
    """What the head makes of an observation; joint steps are encoded (see `to_step`).

    Attributes:
        out: The joint step from the set point, (B, 7).
        proposals: Those that it weighed, (B, k, 7).
        weights: Logits of theirs, (B, k).
    """

    out: Tensor
    proposals: Tensor
    weights: Tensor


class BeliefNetwork(nn.Module):
    """Eyes, belief and head.

    Args:
        shape: Sizes.
        cell: What is known of the cell.
    """

    joint_range: Tensor
    joint_speed: Tensor
    lowest_m: Tensor
    lag_s: Tensor

    def __init__(self, shape: Shape, cell: CellModel) -> None:
        super().__init__()
        self.shape, self.cell = shape, cell
        cameras = tuple(shape.cameras)
        self.eyes = nn.ModuleDict(
            {
                n: Eye(c, side, shape.channels, shape.n_goals, slope=self._slope_eye(n))
                for n, (c, side) in shape.cameras.items()
            }
        )
        # Its constants are few, and what makes such on the "meta" device, where the shapes of a
        # checkpoint are checked, imports a compiler: longer than all else that loading takes.
        with torch.device("cpu"):
            self.belief = Belief(cameras, cell.period_s, offsets=shape.offsets)
        self.register_buffer("lowest_m", torch.tensor(-1.0))
        self.register_buffer(
            "joint_range", torch.tensor(JOINT_RANGE_RAD, dtype=torch.float32), persistent=False
        )
        self.register_buffer(
            "joint_speed", torch.tensor(JOINT_SPEED_RAD_S, dtype=torch.float32), persistent=False
        )
        self.register_buffer("lag_s", torch.from_numpy(LAG_S), persistent=False)
        n = len(cameras)
        hidden = shape.hidden
        width = 3 * N_JOINTS + N_JOINTS + N_JOINTS  # q, velocity, pending
        width += 4 * n + RECENT_SIZE  # sightings
        width += N_MOTION + 1 + 3 + 3 + 2  # deviations; velocity, acceleration, slope
        width += 2 * 8  # arm and set point in the goal's frame
        width += shape.n_felt * 2
        width += self._sees_slopes  # the time
        self.width = width
        n_ways = len(HEIGHTS_M) + self._sees_slopes * len(LEANING_HEIGHTS_M)
        way_width = n_ways * (2 * (N_JOINTS - 1) + 2)
        # To which point by the goal: sideways (two) and along the normal, how far ahead, and what
        # is added for where the tip is, and where it was sent.
        # With slopes to see, also how far to lean to either side of the base frame, how much of the
        # lean to keep, and by how much to turn the last joint, which moves the picture alone.
        n_leans = 4 if self._sees_slopes else 2 if shape.slopes else 0
        guide_last = nn.Linear(128, 6 + n_leans)
        nn.init.zeros_(guide_last.weight)
        nn.init.zeros_(guide_last.bias)
        self.guide = nn.Sequential(
            nn.Linear(width, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU(), guide_last
        )
        self.lead_s = nn.Parameter(torch.tensor(0.1))
        self.feedback = nn.Parameter(torch.zeros(2))
        n_proposals = 1 + n_ways
        n_proposals += len(self._fixed_postures)
        way_width += 2 * N_JOINTS * len(self._fixed_postures)
        full = width + way_width + N_JOINTS * n_proposals
        last = nn.Linear(hidden, N_JOINTS + 1 + n_proposals)
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.zero_()
        self.head = nn.Sequential(
            nn.Linear(full, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            last,
        )
        self.residual: Residual | None = None
        if shape.residual_hidden:
            self.residual = Residual(
                width,
                shape.residual_hidden,
                shape.residual_step_m,
                shape.residual_reach_m,
                cell.period_s,
            )
        self.choice: Choice | None = None
        if shape.choice_beyond_m is not None:
            self.choice = Choice(1 + n_proposals, shape.choice_beyond_m)
        self.foresight: Foresight | None = None
        begin = MEMORY_SIZE if self.residual is None else FELT.stop
        self._past = slice(begin, begin)
        if shape.foresight:
            self.foresight = Foresight(shape.foresight, cell.period_s)
            self._past = slice(begin, begin + self.foresight.size)

    # --- the cell ---

    def views(self, motion: FlangeMotion) -> dict[str, View]:
        """Where the cameras are, by the measured joints, float64."""
        cell, n = self.cell, len(motion.position)
        R, p = motion.rotation.double(), motion.position.double()
        views = {}
        for name in self.shape.cameras:
            if name == "eih":
                axes = torch.tensor(cell.eih_rotation, dtype=torch.float64)
                at = torch.tensor(cell.eih_origin, dtype=torch.float64)
                views[name] = View(p + R @ at, R @ axes, cell.tan[name])
            else:
                axes = torch.tensor(cell.eth_rotation, dtype=torch.float64)
                at = torch.tensor(cell.eth_origin, dtype=torch.float64)
                views[name] = View(at.expand(n, 3), axes.expand(n, 3, 3), cell.tan[name])
        return views

    @property
    def eyes_device(self) -> torch.device:
        """Where the eyes are; belief and head are on the processor."""
        return next(self.eyes.parameters()).device

    def look(self, images: Mapping[str, Tensor], goal: Tensor | None = None) -> dict[str, Tensor]:
        """Run the eyes: camera name to sightings (B, 9)."""
        return {name: eye(images[name], goal) for name, eye in self.eyes.items()}

    def see(self, images: Mapping[str, Tensor], goal: Tensor | None = None) -> dict[str, Seen]:
        """Run the eyes, and keep where they looked."""
        eyes = {name: eye for name, eye in self.eyes.items() if isinstance(eye, Eye)}
        return {name: eye.see(images[name], goal) for name, eye in eyes.items()}

    def set_prior(self, prior: Prior, lowest_m: float) -> None:
        """Copy what demonstrations say beforehand into the buffers that are saved with the weights.

        Args:
            prior: Of the belief.
            lowest_m: Height of the lowest goal over the base (m).
        """
        self.belief.set_prior(prior)
        self.lowest_m.fill_(lowest_m)

    # --- one step ---

    def start(self, n: int) -> Tensor:
        """The memory at the beginning of an episode, (n, k) float64."""
        memory = torch.zeros(n, self._past.stop, dtype=torch.float64)
        believed = self.belief.start(n)
        memory[:, :BELIEF_SIZE] = believed[:, :BELIEF_SIZE]
        memory[:, RECENT] = 1.0
        if self.foresight is not None:
            memory[:, self._past] = self.foresight.start(n)
        # Offsets stand at the end, because not every network has them.
        return torch.cat([memory, believed[:, BELIEF_SIZE:]], dim=1)

    def remember(
        self,
        memory: Tensor,
        sightings: Mapping[str, Tensor],
        q: Tensor,
        rays: Sequence[Ray] | None = None,
    ) -> Tensor:
        """Take an observation into the memory.

        Args:
            memory: (B, k), before it.
            sightings: Camera name to (B, 9).
            q: Measured joint positions, (B, 7) rad.
            rays: As `hvs_suite.policies.belief.belief.Belief.rays` makes them of these; None
                computes them.

        Returns:
            (B, k).
        """
        if not self.shape.remembers:
            memory = self._forgotten(memory)
        q = self._joints(memory, q)
        if rays is None or not self.shape.reads_positions:
            views = self.views(geometry.flange_motion(q.double()))
            rays = self.belief.rays(sightings, views)
        past = memory[:, self._past]
        before = torch.cat([memory[:, :BELIEF_SIZE], memory[:, self._past.stop :]], dim=1)
        believed, forget = self.belief(before, rays)
        if self.foresight is not None:
            place, variance = _place_of(before)
            past = self.foresight.remember(past, place, variance, forget)
        begun = memory[:, BEGUN] > 0
        set_point, trailing = (
            torch.where(begun, memory[:, part], q.double()) for part in (SET_POINT, TRAILING)
        )
        recent = memory[:, RECENT]
        logits = torch.cat(
            [s[:, VISIBLE] for s in sightings.values()]
            + [sightings[next(iter(sightings))][:, VISIBLE]] * (2 - len(sightings)),
            dim=1,
        ).double()
        seen = torch.sigmoid(logits)
        # Not seen since it was last forgotten: 1; falls to 0 when it is seen.
        unseen = torch.maximum(recent[:, :2], forget) * (1.0 - seen)
        away = (1.0 - seen) * (recent[:, 2:] * 0.9 + 0.1)
        parts = [believed[:, :BELIEF_SIZE], set_point, trailing, torch.ones_like(set_point[:, :1])]
        parts += [
            memory[:, STEPS] + 1.0,
            unseen,
            away,
            memory[:, MEMORY_SIZE : self._past.start],
            past,
            believed[:, BELIEF_SIZE:],
        ]
        return torch.cat(parts, dim=1)

    def _forgotten(self, memory: Tensor) -> Tensor:
        """A memory (B, k) of nothing but what was sent and felt."""
        fresh = self.start(len(memory))
        sent, felt = slice(SET_POINT.start, RECENT.start), slice(MEMORY_SIZE, self._past.start)
        for kept in (sent, felt):
            fresh[:, kept] = memory[:, kept]
        return fresh

    def feel(
        self,
        memory: Tensor,
        sightings: Mapping[str, Tensor],
        state: Tensor,
        felt: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Take what was felt into the memory of a network with a residual.

        Args:
            memory: (B, k), with this observation in it.
            sightings: Camera name to (B, 9).
            state: (B, 14).
            felt: Wrench at the tip, (B, 6); None without.

        Returns:
            (B, k), and what the residual reads, (B, n).
        """
        assert self.residual is not None
        state = self._read(memory, state)
        place = self._place(memory, state[:, :N_JOINTS])
        read = self._head_inputs(memory, sightings, state, felt, place)
        part = self.residual.remember(
            memory[:, FELT], place.here.position, place.sent.position, felt
        )
        goal, axes = self.goal_frame(memory)
        return _with_felt(memory, part), self.residual.inputs(part, read, goal, axes)

    def move_goal(self, memory: Tensor, share: Tensor) -> Tensor:
        """Move the goal by a share (B, 3) of the residual's largest step; after `feel`."""
        assert self.residual is not None
        part = self.residual.move(memory[:, FELT], share, *self.goal_frame(memory))
        return _with_felt(memory, part)

    def goal_frame(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Where the goal is believed to be, not moved (B, 3) m, and its axes (B, 3, 3), float64."""
        believed = memory[:, :BELIEF_SIZE]
        normal = self.belief.normal(believed)
        sent = geometry.flange_motion(memory[:, SET_POINT])
        return (
            believed[:, PLACE] + self.belief.standoff * normal,
            goal_axes(sent.rotation, normal),
        )

    def commanded(self, memory: Tensor, action: Tensor) -> Tensor:
        """Remember an action (B, 7) in [-1, 1] too: the set point moves towards it."""
        set_point = memory[:, SET_POINT]
        longest = (self.joint_speed * self.cell.period_s).double()
        way = (action * self.joint_range).double() - set_point
        return self.sent_on(
            memory, set_point + torch.maximum(torch.minimum(way, longest), -longest)
        )

    def sent_on(self, memory: Tensor, set_point: Tensor) -> Tensor:
        """The memory once the set point has gone on to another, (B, 7) rad, in a control step.

        How the joints trail is `hvs_suite.cell.robot.after_commands`. Where nothing is remembered
        yet, they rest at the set point.
        """
        before, trailing = memory[:, SET_POINT], memory[:, TRAILING]
        trail = self.lag_s * (set_point - before) / self.cell.period_s
        decay = torch.exp(-self.cell.period_s / self.lag_s)
        trailing = set_point - trail + (trailing - before + trail) * decay
        begun = memory[:, BEGUN] > 0
        memory = memory.clone()
        memory[:, SET_POINT] = set_point
        memory[:, TRAILING] = torch.where(begun, trailing, set_point)
        memory[:, BEGUN] = 1.0
        return memory

    def decide(
        self,
        memory: Tensor,
        sightings: Mapping[str, Tensor],
        state: Tensor,
        felt: Tensor | None = None,
    ) -> Decision:
        """What to do.

        Args:
            memory: (B, k), with this observation in it.
            sightings: Camera name to (B, 9).
            state: (B, 14).
            felt: Wrench at the tip, (B, 6); None without.
        """
        scale = self.shape.error_scale
        state = self._read(memory, state)
        place = self._place(memory, state[:, :N_JOINTS])
        here, sent, goal, normal = place.here, place.sent, place.goal, place.normal
        set_point = memory[:, SET_POINT].float()
        inputs = self._head_inputs(memory, sightings, state, felt, place)
        # The point by the goal, its sideways axes those of the tool.
        guided = self.guide(inputs)
        bound = math.asinh(0.3 / scale)
        by = scale * torch.sinh(guided[:, :3].clamp(-bound, bound))
        side = sent.rotation[:, :, :2]
        side = side - normal[:, :, None] * (normal[:, None] @ side)
        lead = self.lead_s * (1.0 + 0.5 * torch.tanh(guided[:, 3:4]))
        ahead = goal + self._moved(memory, lead)
        waypoint = ahead + (side @ by[:, :2, None])[:, :, 0] + by[:, 2:] * normal
        # The arm trails its set point. What is sent farther, so that it arrives, is linear in where
        # it stands: exactly what a network on a logarithmic scale says only roughly.
        gain = self.feedback + 0.5 * torch.tanh(guided[:, 4:6])
        waypoint = waypoint + gain[:, :1] * (ahead - here.position)
        waypoint = waypoint + gain[:, 1:] * (ahead - sent.position)
        facing = normal.detach()
        if self.shape.slopes:
            if self._sees_slopes:
                most = math.asinh(MOST_LEAN / LEAN_SCALE)
                lean = LEAN_SCALE * torch.sinh(guided[:, 6:8].clamp(-most, most))
            else:
                lean = MOST_LEAN * torch.tanh(guided[:, 6:8])
            facing = _leaning(facing, lean)
            if self._sees_slopes:
                tool = -here.rotation[:, :, 2]
                across = tool - (tool * facing).sum(dim=1, keepdim=True) * facing
                facing = F.normalize(
                    facing + MOST_KEPT * torch.tanh(guided[:, 8:9]) * across, dim=1
                )
            # About the target, so that it stays in view.
            reach = self.belief.standoff.float() + by[:, 2:]
            waypoint = waypoint + reach * (facing - normal.detach())
        proposals = [arm.joint_step(sent, waypoint - sent.position, facing)]
        joints, velocity = self._moving(memory, state)
        ways = []
        ahead_s = self.cell.period_s + self.cell.lead_s
        for turns, time_s, within in self._plain_ways(joints, ahead.detach(), normal.detach()):
            gone = arm.along_way(turns, velocity[:, :-1], ahead_s)
            step = gone + (joints - set_point)[:, :-1]
            proposals.append(F.pad(step, (0, 1)))
            ways += [torch.asinh(turns / scale), time_s, within]
            ways.append(torch.asinh(step / scale))
        if self._sees_slopes:
            turn = scale * torch.sinh(guided[:, 9:].clamp(-bound, bound))
            proposals = [proposal + F.pad(turn, (N_JOINTS - 1, 0)) for proposal in proposals]
        for posture in self._fixed_postures:
            turns = joints.new_tensor(posture) - joints
            gone = arm.along_way(turns, velocity, ahead_s, together=False)
            step = gone + joints - set_point
            proposals.append(step)
            ways += [torch.asinh(turns / scale), torch.asinh(step / scale)]
        said = [torch.asinh(p / scale) for p in proposals]
        out = self.head(torch.cat([inputs, *ways, *said], dim=1))
        correction, is_corrected, weights = (
            bound * torch.tanh(part / bound)
            for part, bound in zip(
                out.split([N_JOINTS, 1, len(proposals)], dim=1), OUT_BOUNDS, strict=True
            )
        )
        far = (goal - here.position).norm(dim=1, keepdim=True)
        if self.choice is not None:
            shift = self.choice(far)
            is_corrected, weights = is_corrected + shift[:, :1], weights + shift[:, 1:]
        if self._sees_slopes:
            weights = SURE * weights
        # Weights and gate can become nearly whole: near the goal one proposal is right as it is.
        mean = (weights.softmax(dim=1)[:, :, None] * torch.stack(proposals, dim=1)).sum(dim=1)
        corrected = torch.sigmoid(is_corrected)
        if self.shape.corrects_within_m is not None:
            corrected = corrected * (2.0 - far / self.shape.corrects_within_m).clamp(0.0, 1.0)
        total = torch.asinh(mean / scale) + corrected * correction
        return Decision(total, torch.stack(said, dim=1), weights)

    def _plain_ways(
        self, joints: Tensor, goal: Tensor, normal: Tensor
    ) -> list[tuple[Tensor, Tensor, Tensor]]:
        """The ways to the plain postures that the head is shown.

        Args:
            joints: From where, (B, 7) rad.
            goal: Of the tip, (B, 3) m.
            normal: Of the surface, (B, 3).

        Returns:
            Of each what `arm.way_to_posture` does.
        """
        tool, standoff = self.cell.tool_length_m, self.belief.standoff.float()
        target = goal - standoff * normal
        over = [goal + (height + tool) * normal for height in self._heights_m]
        facings = [(normal, over)]
        if self._sees_slopes:
            leaning = _leaning(normal, ARRIVES_LEANING * F.normalize(target[:, :2], dim=1))
            over = [target + (standoff + height + tool) * leaning for height in LEANING_HEIGHTS_M]
            facings.append((leaning, over))
        ways = []
        for facing, over in facings:
            if self.shape.elbow_aside:
                chosen = target + (CHOSEN_ABOVE_M + tool) * facing
                ways += arm.ways_to_posture(joints, torch.stack(over, dim=1), facing, chosen)
            else:
                ways += [arm.way_to_posture(joints, place, facing) for place in over]
        return ways

    @property
    def _heights_m(self) -> tuple[float, ...]:
        """Above the goal, along its normal: the plain postures that the head is shown."""
        over_m = self.cell.over_m
        return HEIGHTS_M if over_m is None else (*HEIGHTS_M[:-1], over_m)

    @property
    def _fixed_postures(self) -> list[tuple[float, ...]]:
        """Postures to which the head is shown the way wherever the goal is, (7,) rad each."""
        look_out = self.cell.look_out_rad
        upright = [] if self.cell.over_m is None else [(0.0,) * N_JOINTS]
        return upright if look_out is None else [look_out, *upright]

    @property
    def _sees_slopes(self) -> bool:
        """Whether the head may look from the side."""
        return bool(self.shape.slopes) and self.shape.slopes_by == "colour"

    def _slope_eye(self, camera: str) -> SlopeEye | ColourSlopeEye | None:
        """What tells the slopes that a camera sees; None for its eye's own features."""
        if camera not in self.shape.slopes:
            return None
        channels, side = self.shape.cameras[camera]
        if self.shape.slopes_by == "colour":
            return ColourSlopeEye(side, self.cell.tan[camera])
        return SlopeEye(channels, side)

    def _joints(self, memory: Tensor, q: Tensor) -> Tensor:
        """Joint positions as the network knows them, (B, 7) rad: measured, or reckoned."""
        if self.shape.reads_positions:
            return q
        return torch.where(memory[:, BEGUN] > 0, memory[:, TRAILING].to(q.dtype), q)

    def _read(self, memory: Tensor, state: Tensor) -> Tensor:
        """The state (B, 14), with what the network does not read of it reckoned."""
        q, velocity = self._joints(memory, state[:, :N_JOINTS]), state[:, N_JOINTS:]
        if not self.shape.reads_velocities:
            velocity = self._trailing_velocity(memory, q)
        return torch.cat([q, velocity], dim=1)

    def _trailing_velocity(self, memory: Tensor, q: Tensor) -> Tensor:
        """How fast joints at q (B, 7) rad go after where they were sent to, (B, 7) rad/s.

        With latency this is as if what was sent already took effect.
        """
        return ((memory[:, SET_POINT] - q) / self.lag_s).to(torch.float32)

    def _moving(self, memory: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (B, 7) rad and their velocities (rad/s) when the next action takes effect."""
        if not self.cell.latency_steps:
            return state[:, :N_JOINTS], state[:, N_JOINTS:]
        trailing = memory[:, TRAILING]
        return trailing.float(), self._trailing_velocity(memory, trailing)

    def _place(self, memory: Tensor, q: Tensor) -> _Place:
        """Where the tip is by measured joints (B, 7) and set point, and where it has to go."""
        here, sent = (
            arm.tip_of(geometry.flange_motion(each), self.cell.tool_length_m)
            for each in (q, memory[:, SET_POINT].float())
        )
        return _Place(here, sent, *self._goal(memory))

    def _moved(self, memory: Tensor, lead: Tensor) -> Tensor:
        """How far the target will have moved in a time (B, 1) s, (B, 3) m."""
        if self.foresight is None:
            speed, bend = memory[:, VELOCITY].float(), memory[:, ACCELERATION].float()
            return lead * speed + 0.5 * lead**2 * bend
        place, variance = _place_of(memory)
        return self.foresight.ahead(memory[:, self._past], place, variance, lead).float()

    def _head_inputs(
        self,
        memory: Tensor,
        sightings: Mapping[str, Tensor],
        state: Tensor,
        felt: Tensor | None,
        place: _Place,
    ) -> Tensor:
        """What the head reads of the observation and of what is remembered, (B, `width`)."""
        scale = self.shape.error_scale
        q, velocity = state[:, :N_JOINTS], state[:, N_JOINTS:]
        pending = memory[:, SET_POINT].float() - q
        believed = memory[:, :BELIEF_SIZE]
        speed, bend = believed[:, VELOCITY].float(), believed[:, ACCELERATION].float()
        P = believed[:, COVARIANCE].view(-1, N_MOTION, N_MOTION)
        stds = torch.diagonal(P, dim1=1, dim2=2).clamp(min=1e-14).sqrt().float()
        tilt_std = believed[:, TILT_VARIANCE].sqrt().float()
        features = [torch.sin(q), torch.cos(q), q / self.joint_range, velocity / self.joint_speed]
        features.append(torch.asinh(pending / scale))
        for s in sightings.values():
            features += [torch.tanh(s[:, VISIBLE] / 4.0), s[:, UV].clamp(-2, 2)]
            features.append(0.3 * s[:, LOG_DIAMETER])
        features.append(memory[:, RECENT].float())
        features += [0.3 * torch.log(stds), 0.3 * torch.log(tilt_std), 10.0 * speed, 5.0 * bend]
        features.append(place.normal[:, :2])
        for tip in (place.here, place.sent):
            features.append(self._in_goal_frame(tip, place.goal, place.normal))
        if felt is not None:
            features += [felt / 20.0, torch.asinh(felt / 0.5)]
        if self._sees_slopes:
            # It looks from the side for as long as there is time.
            features.append(self.cell.period_s * memory[:, STEPS].float())
        return torch.cat(features, dim=1)

    def _in_goal_frame(self, tip: FlangeMotion, goal: Tensor, normal: Tensor) -> Tensor:
        """Where a tip is by the goal, along tool and normal, and how tilted it is, (B, 8)."""
        scale = self.shape.error_scale
        offset = tip.position - goal
        height = (offset * normal).sum(dim=1, keepdim=True)
        side = (offset[:, None] @ tip.rotation[:, :, :2])[:, 0]
        lateral = (offset - height * normal).norm(dim=1, keepdim=True)
        tilt = (normal[:, None] @ tip.rotation[:, :, :2])[:, 0]
        return torch.cat(
            [
                torch.asinh(side / scale),
                torch.asinh(height / scale),
                torch.asinh(lateral / scale),
                2.0 * height,
                2.0 * lateral,
                torch.asinh(tilt / scale),
            ],
            dim=1,
        )

    # --- out ---

    def to_step(self, out: Tensor) -> Tensor:
        """Joint step that the head's output stands for, both (B, 7), rad."""
        bound = math.asinh(1.0 / self.shape.error_scale)
        return self.shape.error_scale * torch.sinh(out.clamp(-bound, bound))

    def to_action(self, out: Tensor, memory: Tensor) -> Tensor:
        """Decode the head's output, and keep the tip from going beyond the goal.

        Args:
            out: (B, 7).
            memory: With this observation in it, (B, k).

        Returns:
            Joint position targets in units of the joint range, (B, 7) in [-1, 1], multiples of
            1 / `ACTION_UNITS`.
        """
        # The set point goes no faster; what is farther would be let go of later, if at all.
        longest = self.joint_speed * self.cell.period_s
        step = torch.maximum(torch.minimum(self.to_step(out), longest), -longest)
        target = memory[:, SET_POINT].float() + step
        goal, normal = self._goal(memory)
        P = memory[:, COVARIANCE].view(-1, N_MOTION, N_MOTION)[:, PLACE, PLACE].float()
        doubt = (normal * (P @ normal[:, :, None])[:, :, 0]).sum(dim=1, keepdim=True)
        doubt = doubt.clamp(min=0.0).sqrt()
        lowest = self.lowest_m - arm.BEYOND_M
        target = arm.kept_above(target, goal, normal, doubt, lowest, self.cell.tool_length_m)
        # Far finer than the arm goes (3 um at the tip), and logs of it are short, if no zero has a
        # sign.
        action = (target / self.joint_range).clamp(-1.0, 1.0)
        return torch.round(action * ACTION_UNITS) / ACTION_UNITS + 0.0

    def _goal(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Where the tip is taken to have to go (B, 3) m, and the normal there (B, 3)."""
        believed = memory[:, :BELIEF_SIZE]
        normal = self.belief.normal(believed)
        goal = believed[:, PLACE] + self.belief.standoff * normal
        if self.residual is not None:
            goal = goal + memory[:, FELT][:, SHIFT]
        return goal.float(), normal.float()

    def encode_label(self, action: Tensor, memory: Tensor) -> Tensor:
        """Inverse of `to_action` without the clipping: what the head should have said, (B, 7)."""
        step = action * self.joint_range - memory[:, SET_POINT].float()
        return torch.asinh(step / self.shape.error_scale)


def _with_felt(memory: Tensor, part: Tensor) -> Tensor:
    """A memory (B, k) with what the residual remembers replaced."""
    return torch.cat([memory[:, :MEMORY_SIZE], part, memory[:, FELT.stop :]], dim=1)


def _place_of(believed: Tensor) -> tuple[Tensor, Tensor]:
    """Where a belief (B, k) has the target, (B, 3) m, and the variance of each coordinate."""
    P = believed[:, COVARIANCE].view(-1, N_MOTION, N_MOTION)
    return believed[:, PLACE], torch.diagonal(P, dim1=1, dim2=2)[:, PLACE]


def _leaning(normal: Tensor, lean: Tensor) -> Tensor:
    """A unit normal (B, 3) leaning by tangents (B, 2) to the base frame's x and y across it."""
    x = normal.new_tensor([1.0, 0.0, 0.0]) - normal[:, :1] * normal
    x = x / x.norm(dim=1, keepdim=True)
    leaning = normal + lean[:, :1] * x + lean[:, 1:] * torch.linalg.cross(normal, x, dim=1)
    return leaning / leaning.norm(dim=1, keepdim=True)
