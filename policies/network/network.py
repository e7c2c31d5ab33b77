"""The `hvs` network in plain torch: two images and the joints in, a joint step out.

Each camera has its own small convolutional encoder that ends in one *keypoint*: the softmax of one
channel is a distribution over the image, its mean the target's centre. The keypoints are placed in
space by fixed geometry, and a small perceptron turns joints and target into a joint step on a
logarithmic scale, so that it learns from errors of a micrometre and of a metre alike. A memory of a
few numbers, which the caller keeps, holds three things: where each camera last saw the target, for
when it does not see it; the mean of the heights that the target's size has shown so far; and where
the arm has already been sent.

No LeRobot in here: a rollout worker starts in the time torch takes to import.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from hvs_suite.datasets.looking import LOOK_DOWN_M, LOOK_OUT_RAD
from hvs_suite.datasets.planner import LEAD_S
from hvs_suite.policies.network import geometry
from hvs_suite.policies.network.geometry import Calibration

IMAGE_PREFIX = "observation.images."
STATE = "observation.state"
MEMORY = "memory"
"""Key of a batch: what the policy remembers, see `HvsNetwork.forward`."""
N_JOINTS = 7
SLOT_SIZE = 4
"""Numbers that are remembered of each camera."""
HEIGHT_SUMS = slice(-N_JOINTS - 3, -N_JOINTS - 1)
SET_POINT = slice(-N_JOINTS - 1, -1)
"""Where these stand in the memory, behind the cameras' slots; last comes 1 once there is any."""
FEATURE_SIZE = 28
"""Cells along the side of a feature map, about."""
OUTLINE_SIZE = 7
"""Cells along the side of the coarse picture of a disc's outline."""
SIGHTING_FEATURES = 5
ERROR_SCALE = 0.005
"""Joint steps (rad) and offsets (m) are read and learned as asinh(x / this): linear below,
logarithmic above. The default suits a tolerance of a millimetre."""
RESIDUAL_BOUND = 0.6
"""The most that fine-tuning may change the head's output: less than a factor of two in a joint step
that is large, and less than two thirds of the error scale in one that is small."""
POSITIONS_AND_VELOCITIES = 2 * N_JOINTS
SEEN_LOGIT = 2.0
"""How sure an eye must be (as a logit) that it sees the target before its place is remembered, and
that it does not, before the arm looks for it elsewhere."""
NEVER_LOGIT = -20.0
"""What cannot be in view at all: its weight is below a float's precision beside any other."""
ESTIMATE_FEATURES = 7
WAY_FEATURES = 2 * (N_JOINTS - 1) + 2
"""Of each of `HvsNetwork._ways`."""
CONTROL_PERIOD_S = 0.1
"""Of all named tasks."""


def memory_size(n_cameras: int) -> int:
    """Numbers that a policy remembers.

    Args:
        n_cameras: How many cameras it has.
    """
    return SLOT_SIZE * n_cameras + 2 + N_JOINTS + 1


@dataclasses.dataclass(frozen=True)
class Shape:
    """Sizes that decide which weights there are.

    Attributes:
        cameras: Name (``eih``, ``eth``) to (channels, side in px), the eye in hand first.
        state_dim: 14 for joint positions and velocities, 7 for positions alone, 0 for neither.
        channels: Channels of the encoders.
        hidden: Width of the perceptron.
        error_scale: See `ERROR_SCALE`; decides what the weights mean.
        residual_hidden: Width of the residual that fine-tuning learns; 0 for none.
        residual_bound: The most that it adds to the head's output.
        from_set_point: Steps are counted from the set point, and not from the measured joints.
    """

    cameras: Mapping[str, tuple[int, int]]
    state_dim: int
    channels: int
    hidden: int
    error_scale: float = ERROR_SCALE
    residual_hidden: int = 0
    residual_bound: float = RESIDUAL_BOUND
    from_set_point: bool = False


def shape_from_config(config: Mapping[str, Any]) -> Shape:
    """Read the sizes from a checkpoint's ``config.json``.

    Args:
        config: The parsed file.

    Returns:
        The sizes.

    Raises:
        KeyError: The file is not that of an `hvs` policy.
    """
    features = config["input_features"]
    cameras = {
        key.removeprefix(IMAGE_PREFIX): (int(value["shape"][0]), int(value["shape"][1]))
        for key, value in sorted(features.items())
        if key.startswith(IMAGE_PREFIX)
    }
    state_dim = int(features[STATE]["shape"][0]) if STATE in features else 0
    return Shape(
        cameras,
        state_dim,
        int(config["channels"]),
        int(config["hidden"]),
        float(config["error_scale"]),
        int(config.get("residual_hidden", 0)),
        float(config.get("residual_bound", RESIDUAL_BOUND)),
        bool(config.get("from_set_point", False)),
    )


@dataclasses.dataclass(frozen=True)
class Sighting:
    """What one camera's encoder makes of its images.

    Attributes:
        uv: Centre of the target in [-1, 1], (B, 2).
        log_diameter: Logarithm of the apparent diameter in image widths, (B, 1).
        visible_logit: Logit that the target is in view, (B, 1).
        trust_logit: How far to trust the centre against the other camera's, (B, 1); learned from
            where the target turns out to be, also where a mere rim of it is in view.
    """

    uv: Tensor
    log_diameter: Tensor
    visible_logit: Tensor
    trust_logit: Tensor

    def features(self) -> Tensor:
        """What the head reads of it, (B, 5)."""
        logits = torch.cat([self.visible_logit, self.trust_logit], dim=1)
        return torch.cat([self.uv, self.log_diameter, torch.tanh(logits / 4.0)], dim=1)


@dataclasses.dataclass(frozen=True, eq=False)
class Decision:
    """What the network makes of one observation.

    Attributes:
        out: What the network says, (B, 7), see `HvsNetwork.to_action`.
        features: What a residual reads, (B, n): the head's inputs, and what it is added to, which
            is what of the head's own output the set point can follow.
        sightings: Camera name to what it saw.
        target: Where the target is taken to be, (B, 3) m in the base frame; None without joints.
        memory: What to remember for the next observation, (B, 4 n + 10) for n cameras, before
            the action is known, see `HvsNetwork.commanded`; None without joints.
        motion: Where the flange is, by the measured joints; None without them.
    """

    out: Tensor
    features: Tensor
    sightings: dict[str, Sighting]
    target: Tensor | None
    memory: Tensor | None
    motion: geometry.FlangeMotion | None


def strides(side: int) -> tuple[int, ...]:
    """Strides of 4, 3 or 2 px that bring an image to about `FEATURE_SIZE` cells.

    Args:
        side: Side of the square image (px).

    Returns:
        Strides of the down-sampling convolutions; empty for tiny images.
    """
    factor = max(1, round(side / FEATURE_SIZE))
    plan: list[int] = []
    while factor > 1:
        step = 3 if factor % 3 == 0 else 2
        plan.append(step)
        factor = round(factor / step)
    return tuple(sorted(plan, reverse=True))


class Eye(nn.Module):
    """Encoder of one camera, ending in a keypoint.

    Args:
        in_channels: Channels of the image.
        side: Side of the image (px).
        channels: Channels of the features.

    Attributes:
        train_in_bfloat16: Train the convolutions in bfloat16, where the processor is faster at it.
            Evaluation is always in float32, and so is everything that measures.
    """

    train_in_bfloat16 = False

    def __init__(self, in_channels: int, side: int, channels: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = in_channels
        plan = strides(side)
        for i, stride in enumerate(plan):
            out = channels if i == len(plan) - 1 else max(8, channels >> (len(plan) - 1 - i))
            size = 5 if i == 0 else 3
            layers += [nn.Conv2d(width, out, size, stride, size // 2), nn.ReLU(inplace=True)]
            width = out
        for _ in range(2):
            layers += [nn.Conv2d(width, channels, 3, 1, 1), nn.ReLU(inplace=True)]
            width = channels
        self.features = nn.Sequential(*layers)
        # One channel for the centre, one for the outline.
        self.score = nn.Linear(channels, 2)
        # A mean over cells cannot reach the border, and strides shift it by a fraction of a cell.
        self.uv_scale = nn.Parameter(torch.full((2,), 1.05))
        self.uv_shift = nn.Parameter(torch.zeros(2))
        last = nn.Linear(96, 5)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.tensor([0.0, 0.0, math.log(0.15), 0.0, 0.0]))
        self.judge = nn.Sequential(
            nn.Linear(2 * channels + OUTLINE_SIZE**2 + 4, 96), nn.SiLU(), last
        )

    def forward(self, images: Tensor) -> Sighting:
        """Find the target.

        Args:
            images: (B, C, H, W), uint8, or float in [0, 1].

        Returns:
            Where it is, how large, and whether it is there.
        """
        maps = self._maps(images)  # (B, h, w, channels)
        scores, outline = self.score(maps).unbind(dim=3)  # (B, h, w) each
        weights = torch.softmax(scores.flatten(1), dim=1)
        grid = weights.view_as(scores)
        u, u_spread = _moments(grid.sum(dim=1))
        v, v_spread = _moments(grid.sum(dim=2))
        uv = torch.cat([u, v], dim=1)
        flat = maps.flatten(1, 2)
        filled = F.adaptive_avg_pool2d(torch.sigmoid(outline)[:, None], OUTLINE_SIZE)
        pooled = [(weights[:, None] @ flat)[:, 0], flat.amax(dim=1), filled.flatten(1)]
        judged = self.judge(torch.cat([*pooled, uv, u_spread, v_spread], dim=1))
        # A disc that is cut by the image's border has its centre elsewhere than what is in view.
        correction, size, visible, trust = judged.split((2, 1, 1, 1), dim=1)
        uv = uv * self.uv_scale + self.uv_shift + correction
        return Sighting(uv, size, visible, trust)

    def attention(self, images: Tensor) -> Tensor:
        """Where the eye looks for the target.

        Args:
            images: (B, C, H, W), uint8, or float in [0, 1].

        Returns:
            The distribution whose mean is the keypoint, (B, h, w), summing to 1.
        """
        scores = self.score(self._maps(images))[..., 0]
        return torch.softmax(scores.flatten(1), dim=1).view_as(scores)

    def _maps(self, images: Tensor) -> Tensor:
        """Features of every cell, (B, h, w, channels)."""
        half = self.train_in_bfloat16 and self.training
        if images.dtype == torch.uint8:
            # Bytes less their mean are exact in bfloat16, and half the size to begin with.
            x = images.to(torch.bfloat16 if half else torch.float32).sub_(127.5).mul_(1.0 / 255.0)
        else:
            x = images - 0.5
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=half):
            maps: Tensor = self.features(x)
        return maps.float().permute(0, 2, 3, 1)


def _moments(marginal: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation in [-1, 1] of a distribution over n cells, (B, 1) each."""
    n = marginal.shape[1]
    centres = (2.0 * torch.arange(n, device=marginal.device, dtype=marginal.dtype) + 1.0) / n - 1.0
    mean = (marginal * centres).sum(dim=1, keepdim=True)
    variance = (marginal * centres**2).sum(dim=1, keepdim=True) - mean**2
    return mean, variance.clamp(min=1e-8).sqrt()


class HvsNetwork(nn.Module):
    """Eyes, geometry and head.

    Args:
        shape: Sizes.
    """

    joint_range: Tensor
    joint_speed: Tensor
    rays: Tensor
    homography: Tensor
    plane_height: Tensor
    standoff: Tensor
    size_at_1m: Tensor
    lowest_goal: Tensor

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.eyes = nn.ModuleDict(
            {name: Eye(c, side, shape.channels) for name, (c, side) in shape.cameras.items()}
        )
        range_rad = torch.tensor(JOINT_RANGE_RAD, dtype=torch.float32)
        self.register_buffer("joint_range", range_rad, persistent=False)
        speed_rad_s = torch.tensor(JOINT_SPEED_RAD_S, dtype=torch.float32)
        self.register_buffer("joint_speed", speed_rad_s, persistent=False)
        self.register_buffer("rays", torch.diag(torch.tensor([0.7, 0.7, 1.0])))
        self.register_buffer("homography", torch.eye(3))
        self.register_buffer("plane_height", torch.tensor(0.0))
        self.register_buffer("standoff", torch.tensor(0.05))
        self.register_buffer("size_at_1m", torch.tensor(0.0))
        # Until it is set, no height is too low.
        self.register_buffer("lowest_goal", torch.tensor(-math.inf))
        n_cameras = len(shape.cameras)
        width = SIGHTING_FEATURES * n_cameras
        if shape.state_dim:
            # What each camera sees, what it saw, and what is made of all that.
            n_estimates = 2 * n_cameras + 1
            width += 3 * N_JOINTS + 12 + ESTIMATE_FEATURES * n_estimates + N_JOINTS
            width += WAY_FEATURES + 3 * N_JOINTS
            if "eih" in shape.cameras:
                width += 1 + WAY_FEATURES + 1 + N_JOINTS + 1
            if shape.state_dim == POSITIONS_AND_VELOCITIES:
                width += N_JOINTS
        hidden = shape.hidden
        last = nn.Linear(hidden, N_JOINTS)
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.weight.mul_(0.1)
        self.head = nn.Sequential(
            nn.Linear(width, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            last,
        )
        # How far to trust what each camera saw before; cameras say of their own how far to trust
        # what they see.
        self.memory_trust = nn.Parameter(torch.zeros(n_cameras))
        self.step_gain = nn.Parameter(torch.full((N_JOINTS,), 0.5))
        self.stride_gain = nn.Parameter(torch.full((N_JOINTS,), 0.5))
        if not shape.from_set_point:
            self.onward_step_gain = nn.Parameter(torch.zeros(N_JOINTS))
            self.onward_stride_gain = nn.Parameter(torch.zeros(N_JOINTS))
        # How much higher to aim until the eye in the hand has seen the target.
        self.above_gain = nn.Parameter(torch.zeros(1))
        # How many looks from the goal it takes to believe half of the height that they show.
        self.log_height_doubt = nn.Parameter(torch.zeros(()))
        self.n_features = width + N_JOINTS
        self.residual = (
            make_residual(self.n_features, shape.residual_hidden) if shape.residual_hidden else None
        )

    def set_calibration(self, calibration: Calibration) -> None:
        """Copy camera maps and surface into the buffers that are saved with the weights."""
        self.rays.copy_(torch.from_numpy(calibration.rays))
        self.homography.copy_(torch.from_numpy(calibration.homography))
        self.plane_height.fill_(calibration.plane_height_m)
        self.standoff.fill_(calibration.standoff_m)
        self.size_at_1m.fill_(calibration.size_at_1m)
        self.lowest_goal.fill_(calibration.lowest_goal_m)

    @property
    def calibration(self) -> Calibration:
        """Camera maps and surface, as `set_calibration` took them."""
        rays, homography = (m.double().numpy(force=True) for m in (self.rays, self.homography))
        return Calibration(
            rays,
            homography,
            self.plane_height.item(),
            self.standoff.item(),
            self.size_at_1m.item(),
            self.lowest_goal.item(),
        )

    def look(self, images: Mapping[str, Tensor]) -> dict[str, Sighting]:
        """Run the eyes.

        Args:
            images: Camera name to (B, C, H, W), uint8, or float in [0, 1].

        Returns:
            Camera name to what it saw.
        """
        return {name: eye(images[name]) for name, eye in self.eyes.items()}

    def forward(
        self,
        images: Mapping[str, Tensor],
        state: Tensor | None,
        memory: Tensor | None = None,
    ) -> Decision:
        """Decide.

        Args:
            images: Camera name to (B, C, H, W), uint8, or float in [0, 1].
            state: Measured joint positions (rad), then velocities (rad/s), (B, 14) or (B, 7);
                None if the policy has no joint inputs.
            memory: (B, 4 n + 10): for each camera, in the order of the eyes, where it last saw the
                target (m, base frame), and 1 if it ever did in this episode, else 0; the weighted
                sum of the heights (m) that its size showed, and the sum of the weights; the set
                point that all actions so far lead to (rad), and 1 if there is one. None at the
                beginning of an episode.

        Returns:
            The decision.
        """
        # Half a millimetre at the flange is 1e-3 rad: nothing here may be rounded by autocast.
        with torch.autocast(self.joint_range.device.type, enabled=False):
            return self.decide(self.look(images), state, memory)

    def decide(
        self, sightings: dict[str, Sighting], state: Tensor | None, memory: Tensor | None = None
    ) -> Decision:
        """Decide on what the eyes make of the images.

        Args:
            sightings: As `look` returns them.
            state: As in `forward`.
            memory: As in `forward`.

        Returns:
            The decision.
        """
        features = [s.features() for s in sightings.values()]
        if state is None:
            return self._decide_without_joints(sightings, torch.cat(features, dim=1))
        q = state[:, :N_JOINTS]
        if memory is None:
            memory = state.new_zeros(len(state), memory_size(len(sightings)))
        motion = geometry.flange_motion(q)
        target, estimates, slots = self._place(motion, sightings, memory)
        scale = self.shape.error_scale
        lift = torch.zeros_like(target)
        lift[:, 2] = self.standoff
        sums = memory[:, HEIGHT_SUMS]
        if "eih" in sightings:
            # Where the joints give a wrong height, the disc's size gives the right one.
            depth, height, sums = self._height(motion, sightings["eih"], sums)
            lift = lift + F.pad(height, (2, 0))
        goals = [target + lift]
        if "eih" in sightings:
            # Where a demonstrator heads for until the eye in the hand has seen the target.
            goals.append(goals[0] + lift.new_tensor([0.0, 0.0, LOOK_DOWN_M]))
        set_point = torch.where(memory[:, -1:] > 0, memory[:, SET_POINT], q)
        remembered = torch.cat([slots, sums, set_point, torch.ones_like(q[:, :1])], dim=1)
        step = torch.asinh(geometry.joint_step(motion, goals[0] - motion.position) / scale)
        features += [torch.sin(q), torch.cos(q), q / self.joint_range]
        features += [motion.position, motion.rotation.flatten(1), step]
        ways = self._ways(q, goals)
        for turns, time_s, within, each in ways:
            features += [torch.asinh(turns / scale), time_s, within]
            features.append(torch.asinh(each / scale)[:, :-1])
        # From where the arm is sent: it trails its set point, and may not even have begun to move.
        pending = set_point - q
        begun = set_point - self.origin(state, remembered)
        onward_step, onward = self._onward(set_point, begun, goals)
        later = [torch.asinh(pending / scale), onward_step, *onward]
        # What geometry alone would do, each with its gain.
        proposals = [(self.step_gain, onward_step, self.stride_gain, onward)]
        if not self.shape.from_set_point:
            strides = [torch.asinh(each / scale) for *_, each in ways]
            proposals = [
                (self.step_gain, step, self.stride_gain, strides),
                (self.onward_step_gain, onward_step, self.onward_stride_gain, onward),
            ]
        unseen = torch.zeros_like(q[:, :1])
        if "eih" in sightings:
            unseen = 1.0 - remembered[:, SLOT_SIZE - 1 : SLOT_SIZE]
            features.append(unseen)
            features.append(torch.asinh((depth - self.standoff) / scale))
            later.append(torch.asinh(height / scale))
        if self.shape.state_dim == POSITIONS_AND_VELOCITIES:
            features.append(state[:, N_JOINTS:] / self.joint_speed)
        offsets = estimates[:, :, :3] + (lift - motion.position)[:, None]
        in_flange = torch.asinh(offsets @ motion.rotation / scale)
        features.append(torch.cat([offsets, in_flange, estimates[:, :, 3:]], dim=2).flatten(1))
        inputs = torch.cat([*features, *later], dim=1)
        out = self.head(inputs)
        for step_gain, straight, stride_gain, (stride, *above) in proposals:
            for higher in above:
                stride = stride + self.above_gain * unseen * (higher - stride)
            out = out + step_gain * straight + stride_gain * stride
        if not self.training:
            # As long as all cameras are sure that the target is hidden, and none has seen it, the
            # head can know no way there. What it learns in training must not wait for eyes.
            looks_out = self._look_out(set_point, begun)
            out = torch.where(_has_seen(slots, sightings)[:, None], out, looks_out)
        useful = self._within_reach(out, begun)
        out, known = self._with_residual(inputs, out, useful)
        return Decision(out, known, sightings, target, remembered, motion)

    def _decide_without_joints(self, sightings: dict[str, Sighting], inputs: Tensor) -> Decision:
        """Decide on nothing but what the eyes make of the images, (B, n)."""
        out = self.head(inputs)
        out, known = self._with_residual(inputs, out, out)
        return Decision(out, known, sightings, None, None, None)

    def _onward(
        self, set_point: Tensor, begun: Tensor, goals: list[Tensor]
    ) -> tuple[Tensor, list[Tensor]]:
        """What geometry alone would do from where the arm is sent.

        Args:
            set_point: Where that is, (B, 7) rad.
            begun: The same, from where steps are counted, (B, 7) rad.
            goals: Of the flange, (B, 3) m each.

        Returns:
            The straight step to the first goal, and the step towards a plain posture over each, as
            the head says them, (B, 7).
        """
        scale = self.shape.error_scale
        sent = geometry.flange_motion(set_point)
        step = begun + geometry.joint_step(sent, goals[0] - sent.position)
        strides = [torch.asinh((begun + w[-1]) / scale) for w in self._ways(set_point, goals)]
        return torch.asinh(step / scale), strides

    def _ways(self, q: Tensor, goals: list[Tensor]) -> list[tuple[Tensor, ...]]:
        """The ways to plain postures over some goals.

        Args:
            q: Where they begin, (B, 7) rad.
            goals: Of the flange, (B, 3) m each.

        Returns:
            For each goal: what is left of the turns of A1 to A6, (B, 6) rad; its time, (B, 1) s; 1
            if the posture lies within the joint ranges, else 0, (B, 1); and the joint step that
            goes there, (B, 7) rad, A7 at rest.
        """
        n = len(goals)
        turns, time_s, within = geometry.way_to_posture(q.repeat(n, 1), torch.cat(goals))
        step = turns * (CONTROL_PERIOD_S / time_s.clamp(min=CONTROL_PERIOD_S))
        whole = (turns, time_s, within, F.pad(step, (0, 1)))
        return list(zip(*(each.chunk(n) for each in whole), strict=True))

    def origin(self, state: Tensor, memory: Tensor) -> Tensor:
        """From where joint steps are counted.

        Args:
            state: As in `forward`.
            memory: As a `Decision` has it.

        Returns:
            (B, 7) rad.
        """
        return memory[:, SET_POINT] if self.shape.from_set_point else state[:, :N_JOINTS]

    def _look_out(self, set_point: Tensor, begun: Tensor) -> Tensor:
        """The step to where a demonstrator looks for the target, each joint as fast as it can.

        Args:
            set_point: Where the arm has been sent, (B, 7) rad.
            begun: The set point, from where steps are counted, (B, 7) rad.

        Returns:
            As the head says it, (B, 7).
        """
        bound = (CONTROL_PERIOD_S + LEAD_S) * self.joint_speed
        turns = torch.as_tensor(LOOK_OUT_RAD).to(set_point) - set_point
        turns[:, -1] = 0.0
        step = begun + turns.clamp(-bound, bound)
        return torch.asinh(step / self.shape.error_scale)

    def _height(
        self, motion: geometry.FlangeMotion, sighting: Sighting, sums: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """How high the target lies, by its size in the eye in the hand; see `geometry.look_height`.

        Args:
            motion: Of the flange, by the measured joints.
            sighting: Of the eye in the hand.
            sums: Of what earlier looks showed, (B, 2).

        Returns:
            Distance along the optical axis (m), height over the surface (m), (B, 1) each, and the
            sums with this look, (B, 2).
        """
        diameter = torch.exp(sighting.log_diameter.clamp(-5.0, 2.0))
        depth, height, weight = geometry.look_height(
            motion,
            sighting.uv,
            diameter,
            self.rays,
            self.size_at_1m,
            self.plane_height,
            self.standoff,
        )
        weight = weight * (sighting.visible_logit > SEEN_LOGIT)
        sums = sums + torch.cat([weight * height, weight], dim=1)
        believed = sums[:, :1] / (sums[:, 1:] + torch.exp(self.log_height_doubt))
        return depth, believed, sums.detach()

    def _with_residual(self, inputs: Tensor, out: Tensor, useful: Tensor) -> tuple[Tensor, Tensor]:
        """The output, with the residual added to its useful part, and the residual's inputs."""
        known = torch.cat([inputs, useful], dim=1)
        if self.residual is not None:
            out = useful + self.shape.residual_bound * self.residual(known)
        return out, known

    def _within_reach(self, out: Tensor, begun: Tensor) -> Tensor:
        """The part of the head's output that the set point can follow within the joints' speeds.

        A larger output would not move the set point further, but it would hide a residual that is
        added to it.

        Args:
            out: (B, 7).
            begun: The set point, from where steps are counted, (B, 7) rad.

        Returns:
            The output nearest to it that is within a control step of the set point, (B, 7).
        """
        longest = self.joint_speed * CONTROL_PERIOD_S
        ends = (torch.asinh((begun + way) / self.shape.error_scale) for way in (-longest, longest))
        return out.clamp(*ends)

    def _place(
        self, motion: geometry.FlangeMotion, sightings: Mapping[str, Sighting], memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Put the target into space.

        A camera counts as far as it sees the target and is to be trusted; what it remembers, as far
        as it does not see it. If the pose of the eye to hand is not exact, its estimate is wrong by
        centimetres, and what the eye in hand saw a second ago is better.

        Returns:
            The best estimate (B, 3) m; every estimate with its weight, (B, 2 n + 1, 4), what n
            cameras see, what they remember, and the best; and the slots of the next memory
            (B, 4 n).
        """
        places, logits, slots, hidden, held = [], [], [], [], []
        never = motion.position.new_full((len(motion.position), 1), NEVER_LOGIT)
        for i, (name, sighting) in enumerate(sightings.items()):
            visible = sighting.visible_logit
            if name == "eih":
                point = geometry.seen_from_hand(motion, sighting.uv, self.rays, self.plane_height)
                visible = torch.where(point[:, 3:] > 0, visible, never)
            else:
                point = geometry.seen_from_afar(sighting.uv, self.homography, self.plane_height)
            slot = memory[:, SLOT_SIZE * i : SLOT_SIZE * (i + 1)]
            places.append(point[:, :3])
            slots.append(slot)
            logits.append(sighting.trust_logit + F.logsigmoid(visible))
            trust = self.memory_trust[i] + F.logsigmoid(-visible)
            hidden.append(torch.where(slot[:, 3:] > 0, trust, 2.0 * never))
            fresh = torch.cat([point[:, :3], torch.ones_like(visible)], dim=1)
            held.append(torch.where(visible > SEEN_LOGIT, fresh, slot))
        weights = torch.softmax(torch.cat([*logits, *hidden], dim=1), dim=1)
        now = len(places)
        stacked = torch.stack([*places, *(slot[:, :3] for slot in slots)], dim=1)
        best = (weights[:, :, None] * stacked).sum(dim=1)
        # An empty memory is set to the best estimate, so that it has no effect.
        places += [torch.where(slot[:, 3:] > 0, slot[:, :3], best) for slot in slots]
        weights = torch.cat([weights, weights[:, :now].sum(dim=1, keepdim=True)], dim=1)
        estimates = torch.cat([torch.stack([*places, best], dim=1), weights[:, :, None]], dim=2)
        return best, estimates, torch.cat(held, dim=1).detach()

    def to_action(self, out: Tensor, origin: Tensor | None) -> Tensor:
        """Decode the head's output, and keep the flange from going below where goals lie.

        An arm that comes down fast, with joints that move against each other, may get some
        centimetres too low.

        Args:
            out: (B, 7).
            origin: See `origin`; None for a policy without joints.

        Returns:
            Joint position targets in units of the joint range, (B, 7) in [-1, 1].
        """
        if origin is None:
            return out.clamp(-1.0, 1.0)
        target = self.to_target(out, origin)
        return self.within_bounds(target, geometry.flange_motion(target).position[:, 2:])

    def commanded(self, memory: Tensor, action: Tensor) -> Tensor:
        """Remember an action too.

        Args:
            memory: As a `Decision` has it, (B, 4 n + 10).
            action: What is done about it, (B, 7) in [-1, 1].

        Returns:
            What to remember for the next observation: the set point moved towards the action, as
            fast as the joints may.
        """
        set_point = memory[:, SET_POINT]
        longest = self.joint_speed * CONTROL_PERIOD_S
        way = action * self.joint_range - set_point
        memory = memory.clone()
        memory[:, SET_POINT] = set_point + way.clamp(-longest, longest)
        return memory

    def to_target(self, out: Tensor, origin: Tensor) -> Tensor:
        """Joint angles that the head's output stands for, (B, 7) rad, bounds not looked at.

        Args:
            out: (B, 7).
            origin: See `origin`.
        """
        return origin + self.to_step(out)

    def within_bounds(self, target: Tensor, height: Tensor) -> Tensor:
        """The action that comes nearest to joint angles and keeps the bounds.

        Args:
            target: (B, 7) rad.
            height: Of the flange there, (B, 1) m.

        Returns:
            As `to_action` does.
        """
        least = self.lowest_goal - geometry.LEAST_HEIGHT_MARGIN_M
        if (height < least).any():
            target = geometry.lifted(target, least)
        return (target / self.joint_range).clamp(-1.0, 1.0)

    def to_step(self, out: Tensor) -> Tensor:
        """Joint step that the head's output stands for, both (B, 7), rad."""
        # A step of more than a radian helps no control period.
        bound = math.asinh(1.0 / self.shape.error_scale)
        return self.shape.error_scale * torch.sinh(out.clamp(-bound, bound))

    def encode_label(self, action: Tensor, origin: Tensor | None) -> Tensor:
        """Inverse of `to_action` without the clipping: what the head should have said.

        Args:
            action: The expert's joint position targets in units of the joint range, (B, 7).
            origin: See `origin`; None for a policy without joints.

        Returns:
            (B, 7).
        """
        if origin is None:
            return action
        step = action * self.joint_range - origin
        return torch.asinh(step / self.shape.error_scale)


def make_residual(n_features: int, hidden: int) -> nn.Sequential:
    """What fine-tuning adds to the head: features (B, n) to shares of the bound, (B, 7) in [-1, 1].

    It adds nothing at first, because its last layer begins at zero.

    Args:
        n_features: Numbers that it reads.
        hidden: Width of its layers.
    """
    last = nn.Linear(hidden, N_JOINTS)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*normed_layers(n_features, hidden), last, nn.Tanh())


def normed_layers(n_inputs: int, hidden: int) -> list[nn.Module]:
    """Two dense layers with layer norm, as residual and critics have them.

    Args:
        n_inputs: Numbers that the first reads.
        hidden: Width of both.
    """
    return [
        nn.Linear(n_inputs, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
    ]


def action_loss(out: Tensor, label: Tensor) -> Tensor:
    """Huber loss between the head's output and the encoded label, both (B, 7)."""
    return F.smooth_l1_loss(out, label, beta=0.3)


def flange_loss(
    error: Tensor, motion: geometry.FlangeMotion, distance: Tensor, error_scale: float
) -> Tensor:
    """Loss of where a joint step brings the flange, against the way that is left to go.

    A tenth too much of a fast step is a small error for a single joint. But the arm comes down on
    the target in steps of a decimetre, with joints that move against each other. So this loss
    compares the error at the flange with the distance that is left to go.

    Args:
        error: Joint step minus the expert's, (B, 7) rad.
        motion: Where the flange is.
        distance: From flange to goal, (B, 1) m.
        error_scale: Of the network; a twenty-fifth of it counts even at the goal.

    Returns:
        Scalar, logarithmic.
    """
    astray = (motion.jacobian @ error[:, :, None])[:, :, 0]
    # Angles weigh like the offsets they cause half a link away.
    astray = torch.cat([astray[:, :3], 0.2 * astray[:, 3:]], dim=1)
    scale = 0.04 * error_scale + 0.1 * distance
    return torch.asinh(astray.norm(dim=1, keepdim=True) / scale).mean()


def target_loss(target: Tensor, truth: Tensor, error_scale: float) -> Tensor:
    """Loss of the target's place in space, logarithmic beyond the scale, both (B, 3) m."""
    return torch.asinh((target - truth).abs() / error_scale).mean()


def sighting_loss(sighting: Sighting, truth: Tensor) -> Tensor:
    """Loss of a camera against the projected target.

    Args:
        sighting: What the camera saw.
        truth: u, v, apparent diameter in image widths, visible 0/1, (B, 4).

    Returns:
        Scalar: centre and size where the target is in view, and the visibility everywhere.
    """
    visible = truth[:, 3:]
    inside = visible * (truth[:, :2].abs().amax(dim=1, keepdim=True) <= 1.1)
    count = inside.sum().clamp(min=1.0)
    centre = F.smooth_l1_loss(sighting.uv, truth[:, :2], beta=0.01, reduction="none")
    log_diameter = truth[:, 2:3].clamp(min=1e-3).log()
    size = F.smooth_l1_loss(sighting.log_diameter, log_diameter, beta=0.1, reduction="none")
    known = F.binary_cross_entropy_with_logits(sighting.visible_logit, visible)
    return (10.0 * centre * inside).sum() / count + (size * inside).sum() / count + 0.3 * known


def _has_seen(slots: Tensor, sightings: Mapping[str, Sighting]) -> Tensor:
    """Whether a camera has seen the target in this episode, or may see it now, (B,)."""
    seen = slots[:, SLOT_SIZE - 1 :: SLOT_SIZE].amax(dim=1) > 0
    for sighting in sightings.values():
        seen = seen | (sighting.visible_logit[:, 0] > -SEEN_LOGIT)
    return seen
