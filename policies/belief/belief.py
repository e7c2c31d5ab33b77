"""The belief: what the robot thinks the goal is, as a Kalman filter with learned noises.

The state is the target's place, velocity and acceleration, Gaussian with a full covariance, and
the slope of the surface there. Where targets lie is a prior that comes from the demonstrations:
targets that all lie on one level have a flat one, and a ray meets it as it would meet a plane. A
sighting is a ray, on which the target's size says how far away it is. How far to trust each of
them, how much a target may have moved, and when to forget it because it is suddenly elsewhere, a
small network decides from how well what is seen fits what was believed.

A camera whose pose is not exact shows every place beside where it is. Where it is said to, the
filter finds out how that camera is shifted and turned, from what another one sees of the same
targets, and does not forget it with them.

Double precision: variances of a tenth of a millimetre and of half a metre meet in one matrix.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.eye import (
    LOG_DIAMETER,
    LOG_SIGMA_SIZE,
    LOG_SIGMA_SLOPE,
    LOG_SIGMA_UV,
    SLOPE,
    UV,
    VISIBLE,
)
from hvs_suite.policies.belief.geometry import cross

N_MOTION = 9
"""Numbers of the state that move: place (m), velocity (m/s) and acceleration (m/s2)."""
BELIEF_SIZE = N_MOTION + N_MOTION**2 + 2 + 1
PLACE, VELOCITY, ACCELERATION, MOTION, COVARIANCE, TILT, TILT_VARIANCE = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(0, N_MOTION),
    slice(N_MOTION, BELIEF_SIZE - 3),
    slice(BELIEF_SIZE - 3, BELIEF_SIZE - 1),
    slice(BELIEF_SIZE - 1, BELIEF_SIZE),
)
"""Where these, the covariance of the first three, and the slope and its variance stand."""
OFFSET_SIZE = 6
"""How a camera's pose is off: shifted (m) along and turned (rad) about the base's axes."""
MAX_DEPTH_M = 3.5
MIN_DEPTH_M = 0.02
GATES_A_CAMERA = 4
GATES = 4
"""Of all cameras: forgetting, and how much place, motion and slope may have changed."""
CHANGE_SLOPE = 3.0
"""By which the gates of change are multiplied, so that noises are learned three times as fast."""
FORGET_SLOPE = 5.0
FORGET_AT = 3.2
"""A share of 1e-7 is forgotten where the gate says 0: of half a metre, a tenth of a millimetre."""
AHEAD_S = 0.2
"""For how long the arm acts on a velocity that is believed (s): it is there one to two control
steps after it was sent."""
FEATURES_A_CAMERA = 9
FEATURES = 12


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """Where targets are before anything is seen, and how the cameras show them.

    Attributes:
        place: Mean, (3,) m.
        covariance: Of place, velocity and acceleration, (9, 9).
        slope: Mean of the normal's x and y over its z, (2,).
        slope_variance: Of each.
        standoff_m: From the target along its normal to the goal of the tip (m).
        sizes: Camera name to apparent diameter (image widths) times depth (m).
        offsets: Camera name to the variances of how its pose is off: shift (m2) and turn (rad2),
            along and about each axis.
        drifts: Camera name to the variance of what no shift and turn explain, from target to
            target (m2).
    """

    place: Tensor
    covariance: Tensor
    slope: Tensor
    slope_variance: float
    standoff_m: float
    sizes: Mapping[str, float]
    offsets: Mapping[str, tuple[float, float]]
    drifts: Mapping[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """A camera's pose at one moment, nominal, by the measured joints.

    Attributes:
        origin: (B, 3) m.
        rotation: Optical axes as columns, (B, 3, 3).
        tan: Tangent of half the field of view.
    """

    origin: Tensor
    rotation: Tensor
    tan: float


@dataclasses.dataclass(frozen=True, eq=False)
class Ray:
    """A sighting in space: what it says whatever is believed, so that many are computed at once.

    Attributes:
        visible: The logit that the target is in view, (B, 1).
        origin: Of the camera, (B, 3) m.
        along: Unit vector on which the target lies, (B, 3).
        by_size: How far away it lies by its size (m), (B, 1).
        share_var: Variance of that distance, as a share of it, (B, 1).
        angle: Standard deviation across the ray (rad), (B, 1).
        spread_m: The same at that distance, in the picture's plane (m), (B, 1).
        outer: Projector onto the ray, (B, 3, 3).
        rest: Projector onto what is across it, (B, 3, 3).
        slope: Of the surface at the target, (B, 2).
        slope_var: Its variance, (B, 1).
        upward: Whether the normal that is seen points up, as that of a surface does, (B, 1) bool.
        features: Of the sighting alone, (B, 6).
    """

    visible: Tensor
    origin: Tensor
    along: Tensor
    by_size: Tensor
    share_var: Tensor
    angle: Tensor
    spread_m: Tensor
    outer: Tensor
    rest: Tensor
    slope: Tensor
    slope_var: Tensor
    upward: Tensor
    features: Tensor

    def steps(self, n: int) -> "list[Ray]":
        """Rays of B windows one after the other, (B * n, ...), as those of each step, (B, ...)."""
        fields = [field.name for field in dataclasses.fields(self)]
        parts = [getattr(self, name).unflatten(0, (-1, n)).unbind(dim=1) for name in fields]
        return [Ray(*step) for step in zip(*parts, strict=True)]

    @torch.no_grad()
    def likeliest(self, place: Tensor, P: Tensor, share_var: Tensor) -> Tensor:
        """How far away it is most likely met (B, 1) m: by a Gaussian place, and by the size."""
        d = self.along
        Pd = (torch.linalg.inv(P) @ d[:, :, None])[:, :, 0]
        weight = (Pd * d).sum(dim=1, keepdim=True)
        at = (Pd * (place - self.origin)).sum(dim=1, keepdim=True)
        size_weight = 1.0 / (share_var * self.by_size**2)
        depth = (at + size_weight * self.by_size) / (weight + size_weight)
        return depth.clamp(MIN_DEPTH_M, MAX_DEPTH_M)

    def fit(self, place: Tensor, P: Tensor) -> Tensor:
        """How it fits where its camera should show the target, (B, `FEATURES_A_CAMERA`)."""
        offset = place - self.origin
        along = (offset * self.along).sum(dim=1, keepdim=True)
        miss_m = (offset - along * self.along).norm(dim=1, keepdim=True)
        spread = torch.diagonal(P, dim1=1, dim2=2).sum(dim=1, keepdim=True)
        doubt = torch.sqrt(spread + self.spread_m**2)
        features = [
            self.features,
            0.2 * torch.log(miss_m / doubt + 1e-3),
            0.2 * torch.log(miss_m + 1e-4),
            (along / self.by_size - 1.0).clamp(-2.0, 2.0),
        ]
        return torch.cat(features, dim=1).float()


class Belief(nn.Module):
    """The filter.

    Args:
        cameras: Their names.
        period_s: Control period (s).
        hidden: Width of the network that sets the noises.
        offsets: Cameras of which it finds out how their pose is off.

    Attributes:
        size: Numbers of a belief: `BELIEF_SIZE`, and then the offsets, `OFFSET_SIZE` a camera,
            their covariance with what moves, and their own.
    """

    prior: Tensor
    standoff: Tensor
    sizes: Tensor
    offsets: Tensor
    drifts: Tensor
    transition: Tensor
    unit: Tensor
    restless: Tensor

    def __init__(
        self,
        cameras: tuple[str, ...],
        period_s: float,
        hidden: int = 64,
        *,
        offsets: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        self.cameras = cameras
        n = len(cameras)
        self._off = off = OFFSET_SIZE * len(offsets)
        self._of_offsets = tuple(cameras.index(name) for name in offsets)
        self.size = BELIEF_SIZE + off * (1 + N_MOTION + off)
        start = torch.zeros(BELIEF_SIZE, dtype=torch.float64)
        start[COVARIANCE] = torch.diag(
            torch.tensor([0.25] * 3 + [1e-8] * 6, dtype=torch.float64)
        ).flatten()
        start[TILT_VARIANCE] = 1e-4
        self.register_buffer("prior", start)
        self.register_buffer("standoff", torch.tensor(0.05, dtype=torch.float64))
        self.register_buffer("sizes", torch.full((n,), 0.02, dtype=torch.float64))
        # Variances of the offsets, and how much they grow from target to target.
        for name in ("offsets", "drifts"):
            start_off = torch.full((off,), 1e-4, dtype=torch.float64)
            self.register_buffer(name, start_off, persistent=off > 0)
        eye3 = torch.eye(3, dtype=torch.float64)
        # What cameras show: the place, and how they are off. Without that a slice, which is fast.
        offsets_at = range(N_MOTION, N_MOTION + off)
        self._shown: slice | list[int] = [0, 1, 2, *offsets_at] if off else PLACE
        unit = torch.eye(N_MOTION + off, dtype=torch.float64)
        self.register_buffer("unit", unit, persistent=False)
        restless = torch.tensor([1e-6] * 3 + [1e-3] * 3, dtype=torch.float64)
        self.register_buffer("restless", restless, persistent=False)
        transition = unit.clone()
        transition[PLACE, VELOCITY] = transition[VELOCITY, ACCELERATION] = period_s * eye3
        transition[PLACE, ACCELERATION] = 0.5 * period_s**2 * eye3
        self.register_buffer("transition", transition, persistent=False)
        # Floors of what cameras tell: angle (rad), place (m), share of a distance, slope.
        floors = torch.tensor([5e-4, 1e-4, 0.01, 0.01]).log().repeat(n, 1)
        self.log_floors = nn.Parameter(floors)
        last = nn.Linear(hidden, GATES_A_CAMERA * n + GATES)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.gate = nn.Sequential(
            nn.Linear(FEATURES_A_CAMERA * n + FEATURES + off, hidden), nn.SiLU(), last
        )

    def set_prior(self, prior: Prior) -> None:
        """Copy a prior into the buffers that are saved with the weights."""
        self.prior[PLACE] = prior.place
        self.prior[3:N_MOTION] = 0.0
        self.prior[COVARIANCE] = prior.covariance.flatten()
        self.prior[TILT] = prior.slope
        self.prior[TILT_VARIANCE] = prior.slope_variance
        self.standoff.fill_(prior.standoff_m)
        for i, name in enumerate(self.cameras):
            self.sizes[i] = prior.sizes[name]
        for i, camera in enumerate(self._of_offsets):
            shift, turn = prior.offsets[self.cameras[camera]]
            k = OFFSET_SIZE * i
            self.offsets[k : k + 3], self.offsets[k + 3 : k + 6] = shift, turn
            self.drifts[k : k + 3] = prior.drifts[self.cameras[camera]]
            self.drifts[k + 3 : k + 6] = 0.0

    def start(self, n: int) -> Tensor:
        """What is believed before anything is seen, (n, k) float64."""
        unknown = self.prior.new_zeros(self._off * (1 + N_MOTION))
        start = torch.cat([self.prior, unknown, torch.diag(self.offsets).flatten()])
        return start.expand(n, self.size).clone()

    def forward(self, belief: Tensor, rays: Sequence[Ray]) -> tuple[Tensor, Tensor]:
        """One control step: what was believed goes on, and what is seen is taken in.

        Args:
            belief: (B, k) float64.
            rays: Of each camera, as `rays` makes them.

        Returns:
            What is believed now, (B, k), and the gates in (0, 1) that say how much was forgotten,
            (B, 1).
        """
        n = len(belief)
        F = self.transition
        x, P = self._state(belief)
        x, P = x @ F.T, F @ P @ F.T
        slope, slope_var = belief[:, TILT], belief[:, TILT_VARIANCE]
        features = [ray.fit(*self._as_shown(i, x, P, ray)[1:]) for i, ray in enumerate(rays)]
        variances = torch.diagonal(P, dim1=1, dim2=2).clamp(min=1e-14)
        features.append(
            torch.cat([0.2 * variances.log(), 0.2 * slope_var.log(), slope], dim=1).float()
        )
        gates = self.gate(torch.cat(features, dim=1)).double()
        common = gates[:, -GATES:]
        forget = torch.sigmoid(FORGET_SLOPE * (common[:, :1] - FORGET_AT))
        keep = 1.0 - forget
        start = self.prior
        prior_P = start[COVARIANCE].view(N_MOTION, N_MOTION)
        new_x, new_P = self._anew(x, P)
        x = keep * x + forget * new_x
        P = keep[:, :, None] * P + forget[:, :, None] * new_P
        prior_variance = torch.diagonal(prior_P)
        change = torch.exp((CHANGE_SLOPE * common[:, 1:]).clamp(-6.0, 6.0))
        # Velocities change by accelerations, and hardly otherwise.
        of_prior = prior_variance[3:] * self.restless
        q = torch.cat([1e-10 * change[:, :1].expand(n, 3), of_prior * change[:, 1:2]], dim=1)
        q = nn.functional.pad(q, (0, self._off))
        P = P + torch.diag_embed(q)
        slope = keep * slope + forget * start[TILT]
        slope_var = keep * slope_var + forget * start[TILT_VARIANCE] + 1e-8 * change[:, 2:]
        # What the cameras say of the place, as information.
        A = self._shown
        info, vector = [], []
        for i, ray in enumerate(rays):
            gate = gates[:, GATES_A_CAMERA * i : GATES_A_CAMERA * (i + 1)]
            H, place, spread = self._as_shown(i, x, P, ray)
            there = _there(ray, gate)
            Lambda, away = self._measure(i, ray, place, spread, gate, there)
            told = (Lambda @ away[:, :, None])[:, :, 0]
            if H is not None:
                Lambda, told = H.transpose(1, 2) @ Lambda @ H, (told[:, None] @ H)[:, 0]
            elif self._off:
                Lambda = nn.functional.pad(Lambda, (0, self._off, 0, self._off))
                told = nn.functional.pad(told, (0, self._off))
            info.append(Lambda)
            vector.append(told)
            variance = self._slope_variance(i, ray, gate, there)
            share = slope_var / (slope_var + variance)
            slope = slope + share * (ray.slope - slope)
            slope_var = slope_var * (1.0 - share)
        told, Lambda = sum(vector[1:], vector[0]), sum(info[1:], info[0])
        of_shown, unit = P[:, A], self.unit[: 3 + self._off, : 3 + self._off]
        middle = torch.linalg.inv(unit + Lambda @ of_shown[:, :, A])  # (I + L P)^-1
        gain = P[:, :, A] @ middle  # acts on information
        x = x + (gain @ told[:, :, None])[:, :, 0]
        P = P - gain @ Lambda @ of_shown
        P = 0.5 * (P + P.transpose(1, 2)) + 1e-13 * self.unit
        m = MOTION
        updated = [x[:, m], P[:, m, m].flatten(1), slope, slope_var.clamp(min=1e-12)]
        if self._off:
            updated += [x[:, N_MOTION:], P[:, m, N_MOTION:].flatten(1)]
            updated.append(P[:, N_MOTION:, N_MOTION:].flatten(1))
        return torch.cat(updated, dim=1), forget

    def _state(self, belief: Tensor) -> tuple[Tensor, Tensor]:
        """What moves and the offsets, (B, m), and their covariance (B, m, m)."""
        n, off = len(belief), self._off
        x, P = belief[:, MOTION], belief[:, COVARIANCE].view(n, N_MOTION, N_MOTION)
        if not off:
            return x, P
        rest = belief[:, BELIEF_SIZE:]
        offsets, own = rest[:, :off], rest[:, -off * off :].reshape(n, off, off)
        both = rest[:, off : -off * off].reshape(n, N_MOTION, off)
        upper = torch.cat([P, both], dim=2)
        lower = torch.cat([both.transpose(1, 2), own], dim=2)
        return torch.cat([x, offsets], dim=1), torch.cat([upper, lower], dim=1)

    def _anew(self, x: Tensor, P: Tensor) -> tuple[Tensor, Tensor]:
        """The state of `_state` for another target: the cameras are off as before, or nearly."""
        start = self.prior
        prior_P = start[COVARIANCE].view(N_MOTION, N_MOTION)
        if not self._off:
            return start[MOTION], prior_P
        own = P[:, N_MOTION:, N_MOTION:] + torch.diag(self.drifts)
        corner = prior_P.expand(len(x), -1, -1)
        new_P = nn.functional.pad(corner, (0, self._off, 0, self._off))
        new_P = new_P + nn.functional.pad(own, (N_MOTION, 0, N_MOTION, 0))
        return torch.cat([start[MOTION].expand(len(x), -1), x[:, N_MOTION:]], dim=1), new_P

    def rays(self, sightings: Mapping[str, Tensor], views: Mapping[str, View]) -> list[Ray]:
        """What each camera saw, in space.

        Args:
            sightings: Camera name to (B, 9) of its eye. No gradient flows through them.
            views: Camera name to its pose.
        """
        with torch.no_grad():
            return [self._ray(i, sightings[c], views[c]) for i, c in enumerate(self.cameras)]

    def _ray(self, i: int, sighting: Tensor, view: View) -> Ray:
        s = sighting.double()
        uv = s[:, UV].clamp(-1.6, 1.6) * view.tan
        ray = torch.cat([uv, torch.ones_like(uv[:, :1])], dim=1)
        length = ray.norm(dim=1, keepdim=True)
        along = (view.rotation @ (ray / length)[:, :, None])[:, :, 0]
        by_size = self.sizes[i] * torch.exp(-s[:, LOG_DIAMETER].clamp(-6.0, 1.0)) * length
        by_size = by_size.clamp(MIN_DEPTH_M, MAX_DEPTH_M)
        sigma = s[:, LOG_SIGMA_UV].exp() * view.tan
        outer = along[:, :, None] * along[:, None]
        xy = s[:, SLOPE].clamp(-0.95, 0.95)
        z = -torch.sqrt((1.0 - xy.square().sum(dim=1, keepdim=True)).clamp(min=0.05))
        normal = (view.rotation @ torch.cat([xy, z], dim=1)[:, :, None])[:, :, 0]
        up = normal[:, 2:]
        visible = s[:, VISIBLE]
        features = [
            torch.tanh(visible / 4.0),
            torch.tanh(visible / 20.0),
            0.3 * s[:, LOG_SIGMA_UV],
            0.3 * s[:, LOG_SIGMA_SIZE],
            0.3 * s[:, LOG_SIGMA_SLOPE],
            0.3 * by_size.log(),
        ]
        return Ray(
            visible=visible,
            origin=view.origin,
            along=along,
            by_size=by_size,
            share_var=s[:, LOG_SIGMA_SIZE].exp() ** 2,
            angle=sigma / length,
            spread_m=sigma * by_size,
            outer=outer,
            rest=torch.eye(3, dtype=s.dtype) - outer,
            slope=(normal[:, :2] / up.clamp(min=0.2)).clamp(-1.5, 1.5),
            slope_var=s[:, LOG_SIGMA_SLOPE].clamp(-7.0, 2.0).exp() ** 2,
            upward=up > 0.2,
            features=torch.cat(features, dim=1),
        )

    def _as_shown(
        self, i: int, x: Tensor, P: Tensor, ray: Ray
    ) -> tuple[Tensor | None, Tensor, Tensor]:
        """Where a camera shows the target, (B, 3) m, and the covariance, (B, 3, 3).

        A camera taken to be at o that is shifted by -s and turned by -w, both small, shows a place
        p at p + s + w x (p - o). The way p - o is taken along the ray, by what is believed of p.

        Returns:
            Before them, what of place and offsets this is, (B, 3, 3 + offsets); None where it is
            the place itself.
        """
        if i not in self._of_offsets:
            return None, x[:, PLACE], P[:, PLACE, PLACE]
        A = self._shown
        H = torch.eye(3, 3 + self._off, dtype=P.dtype).repeat(len(x), 1, 1)
        k = 3 + OFFSET_SIZE * self._of_offsets.index(i)
        share_var = ray.share_var + self.log_floors[i, 2].double().exp() ** 2
        depth = ray.likeliest(x[:, PLACE], P[:, PLACE, PLACE], share_var)
        H[:, :, k : k + 3] = torch.eye(3, dtype=P.dtype)
        H[:, :, k + 3 : k + 6] = cross(-depth * ray.along)
        return H, (H @ x[:, A, None])[:, :, 0], H @ P[:, A][:, :, A] @ H.transpose(1, 2)

    def _measure(
        self, i: int, ray: Ray, place: Tensor, P: Tensor, gate: Tensor, there: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What a ray says of the place: information (B, 3, 3), and how far off it is (B, 3) m."""
        floors = self.log_floors[i].double().exp() ** 2
        loud = torch.exp(4.0 * torch.tanh(gate[:, :2] / 2.0))  # of variances, e^-4 to e^4
        share_var = (ray.share_var + floors[2]) * loud[:, 1:]
        depth = ray.likeliest(place, P, share_var)
        across_var = (ray.angle**2 + floors[0]) * depth**2 * loud[:, :1] + floors[1]
        along_var = share_var * ray.by_size**2 + floors[1]
        info = ray.rest / across_var[:, :, None] + ray.outer / along_var[:, :, None]
        return there[:, :, None] ** 2 * info, ray.origin + ray.by_size * ray.along - place

    def _slope_variance(self, i: int, ray: Ray, gate: Tensor, there: Tensor) -> Tensor:
        """Of the slope that a sighting tells, (B, 1)."""
        floor = self.log_floors[i, 3].double().exp()
        variance = (ray.slope_var + floor**2) * torch.exp(4.0 * torch.tanh(gate[:, 2:3] / 2.0))
        return variance / ((there * ray.upward) ** 2 + 1e-9)

    def normal(self, belief: Tensor) -> Tensor:
        """Unit normal of the surface at the target, (B, 3)."""
        slope = belief[:, TILT]
        n = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
        return n / n.norm(dim=1, keepdim=True)


def _there(ray: Ray, gate: Tensor) -> Tensor:
    """How far a sighting counts, (B, 1) in (0, 1), by the logit that the target is in view.

    Sharper than the probability, and the filter's network moves the logit by one at most. An eye
    makes the same mistake at every step, so what is worth next to nothing once would make the
    belief sure of a wrong place in forty steps.
    """
    return torch.sigmoid(2.0 * (ray.visible + torch.tanh(gate[:, 3:])))


def belief_loss(
    belief: Tensor, place: Tensor, velocity: Tensor, slope: Tensor, scale_m: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """How likely the truth is by what is believed, and how far off its mean is.

    Args:
        belief: (n, k).
        place: (n, 3) m.
        velocity: (n, 3) m/s.
        slope: (n, 2).
        scale_m: Errors below this weigh linearly, above logarithmically (m).

    Returns:
        Scalar, and its parts.
    """
    n = len(belief)
    off = torch.cat([place - belief[:, PLACE], velocity - belief[:, VELOCITY]], dim=1).double()
    P = belief[:, COVARIANCE].view(n, N_MOTION, N_MOTION)[:, :3, :3]
    e = off[:, :3]
    squared = (e * (torch.linalg.inv(P) @ e[:, :, None])[:, :, 0]).sum(dim=1)
    place_nll = 0.5 * torch.logdet(P) + 3.5 * torch.log1p(squared / 4.0)
    slope_var = belief[:, TILT_VARIANCE][:, 0]
    slope_off = (slope - belief[:, TILT]).square().sum(dim=1)
    slope_nll = slope_var.log() + 3.0 * torch.log1p(slope_off / slope_var / 4.0)
    parts = {
        "place": torch.asinh(e.abs() / scale_m).mean(),
        "place_nll": 0.05 * place_nll.mean(),
        "velocity": 0.5 * torch.asinh(AHEAD_S * off[:, 3:].abs() / scale_m).mean(),
        "slope_nll": 0.05 * slope_nll.mean(),
        "slope": 0.3 * torch.asinh((slope - belief[:, TILT]).abs() / 0.02).mean(),
    }
    return sum(parts.values(), torch.zeros((), dtype=torch.float64)), parts
