"""How well a target on a curve can be foreseen: see moving-targets.md.

Predicts ``track-hard``'s motions of split ``dev`` from noisy places, one a control step, as far
ahead as an action that acts a step late needs. An episode is lost if one of the last 20 predictions
is off by more than the tolerance. No arm and no pictures: what is left is the motion alone.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

import hvs_suite
from hvs_suite.policies.belief.foresight import Foresight
from hvs_suite.policies.servo.motion_estimate import MotionEstimate
from hvs_suite.policies.servo.target_estimate import Sighting

FloatArray = npt.NDArray[np.float64]
Predict = Callable[[FloatArray], FloatArray]
"""From places seen, (n, 2) m, to those that the last `COUNTED` of them foretell, (m, 2) m."""

SCENES = 200
TAUGHT_BY = 500
"""Motions of ``train`` that say how targets move."""
REMEMBERED = (10, 20, 30)
PERIOD_S, AHEAD_S = 0.1, 0.2
SEEN, COUNTED, TOLERANCE_M = 69, 20, 0.001
"""Steps with a sighting: the first second goes by on the way to the target."""
SPEED_M_S, ACCELERATION_M_S2 = 0.15, 0.3
SIGHT_M = (0.00002, 0.00005, 0.0001)
"""Errors of a sighting, each axis; the eye in the hand's, measured, are 0.016 mm."""


def kalman(pace: float, jerk: float, noise_m: float) -> Predict:
    """The baseline's filter; pace 0 is constant acceleration."""

    def predict(seen: FloatArray) -> FloatArray:
        estimate = MotionEstimate(0.0, SPEED_M_S, ACCELERATION_M_S2, pace, jerk)
        foretold = []
        for place in seen:
            estimate.pass_time(PERIOD_S)
            estimate.see_eih(Sighting(place, noise_m**2 * np.eye(2), 1.0, True, 0.05, 40.0))
            foretold.append(estimate.place(AHEAD_S)[0])
        return np.array(foretold[-COUNTED:])

    return predict


def gaussian_process(variance_m2: float, noise_m: float) -> Predict:
    """The best linear predictor that knows the family's spectrum, but not the motion."""
    omega = 2.0 * np.pi * np.linspace(0.05, 0.45, 60)
    share = omega**-2 / np.sum(omega**-2)

    def covariance(apart_s: FloatArray) -> FloatArray:
        return variance_m2 * np.cos(np.multiply.outer(apart_s, omega)) @ share + 1.0

    def predict(seen: FloatArray) -> FloatArray:
        # As many places as the first prediction has.
        n = len(seen) - COUNTED + 1
        return np.array([weights @ seen[end : end + n] for end in range(COUNTED)])

    n = SEEN - COUNTED + 1
    times = PERIOD_S * np.arange(1 - n, 1)
    K = covariance(times[:, None] - times) + noise_m**2 * np.eye(n)
    weights = np.linalg.solve(K, covariance(AHEAD_S - times))
    return predict


def remembering(foresight: Foresight, jerk: float, noise_m: float) -> Predict:
    """The policy's foresight, from places that the filter with constant acceleration gives."""
    variance = torch.tensor([[noise_m**2, noise_m**2, 0.0]], dtype=torch.float64)
    lead, nothing = torch.full((1, 1), AHEAD_S), torch.zeros(1, 1)

    def predict(seen: FloatArray) -> FloatArray:
        estimate = MotionEstimate(0.0, SPEED_M_S, ACCELERATION_M_S2, 0.0, jerk)
        past, foretold = foresight.start(1), []
        for place in seen:
            estimate.pass_time(PERIOD_S)
            estimate.see_eih(Sighting(place, noise_m**2 * np.eye(2), 1.0, True, 0.05, 40.0))
            now = torch.from_numpy(np.append(estimate.place(0.0)[0], 0.0))[None]
            moved = foresight.ahead(past, now, variance, lead)
            foretold.append((now + moved)[0, :2].numpy())
            past = foresight.remember(past, now, variance, nothing)
        return np.array(foretold[-COUNTED:])

    return predict


def taught(n_past: int) -> Foresight:
    """Foresight that has learned from motions of ``train``."""
    motions = drawn("train", TAUGHT_BY)
    times = PERIOD_S * np.arange(SEEN + 11)
    now, later = (np.stack([m.place(times + late) for m in motions]) for late in (0.0, 1e-3))
    # On one level.
    place, velocity = (
        np.pad(part, ((0, 0), (0, 0), (0, 1))) for part in (now, (later - now) / 1e-3)
    )
    foresight = Foresight(n_past, PERIOD_S)
    foresight.learn(
        torch.from_numpy(place).flatten(0, 1),
        torch.from_numpy(velocity).flatten(0, 1),
        torch.arange(TAUGHT_BY).repeat_interleave(len(times)),
    )
    return foresight


def drawn(split: str, n: int) -> list[Any]:
    """The first motions of a split."""
    with hvs_suite.load("track-hard", split=split, observations="state") as env:
        return [env.task.source.draw(index).motion for index in range(n)]


def main() -> None:
    """Print a table."""
    motions = drawn("dev", SCENES)
    foresights = {n_past: taught(n_past) for n_past in REMEMBERED}
    variance = float(np.mean([(motion.amplitude**2).sum(axis=0) / 2.0 for motion in motions]))
    random = np.random.default_rng(0)
    pace = ACCELERATION_M_S2 / SPEED_M_S
    for noise in SIGHT_M:
        predictors = {
            "constant acceleration": kalman(0.0, pace * ACCELERATION_M_S2, noise),
            "oscillation of one pace": kalman(pace, 0.25 * pace * ACCELERATION_M_S2, noise),
            "Gaussian process": gaussian_process(variance, noise),
        }
        for n_past, foresight in foresights.items():
            jerk = pace * ACCELERATION_M_S2
            predictors[f"{n_past} places remembered"] = remembering(foresight, jerk, noise)
        worst: dict[str, list[float]] = {name: [] for name in predictors}
        for motion in motions:
            times = 1.0 + PERIOD_S * np.arange(SEEN)
            seen = motion.place(times) + noise * random.normal(size=(SEEN, 2))
            true = motion.place(times[-COUNTED:] + AHEAD_S)
            for name, predict in predictors.items():
                worst[name].append(float(np.hypot(*(predict(seen) - true).T).max()))
        for name, errors_m in worst.items():
            solved = np.mean(np.array(errors_m) <= TOLERANCE_M)
            median, p90 = 1000.0 * np.percentile(errors_m, [50, 90])
            print(
                f"{1000 * noise:.2f} mm | {name} | {median:.2f} | {p90:.2f} | {100 * solved:.0f} %"
            )


if __name__ == "__main__":
    main()
