"""Insert: a peg, its bushing, what may touch, how hard, and what is hidden."""

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_ACCELERATION_RAD_S2
from hvs_suite.datasets.expert import make_expert
from hvs_suite.errors import OptionError
from hvs_suite.rollout import run_episode
from hvs_suite.tasks.insert import DEPTH, PEAK_FORCE
from hvs_suite.tasks.shared.environment import Environment
from hvs_suite.tasks.shared.goal import LATERAL, UP, Tip
from hvs_suite.tasks.shared.peg_and_bushing import WRENCH

FloatArray = npt.NDArray[np.float64]

TASKS = ("insert-wide", "insert-jig", "insert-feel")
BLIND = "eih+wrench+joint_positions"
MAX_PENETRATION_M = 0.00002


@pytest.fixture(scope="module", params=TASKS)
def env(request: pytest.FixtureRequest) -> Any:
    with hvs_suite.load(request.param, split="test", observations=BLIND) as env:
        env.draws = False
        yield env


class Hand:
    """Moves the set point's tip in straight lines, from above a place on the bushing.

    Args:
        env: Where.
        aside_m: How far from the hole's axis (m).
        scenario: Which scenario.
    """

    def __init__(self, env: Environment, aside_m: float, scenario: int = 0) -> None:
        self.env = env
        env.reset(scenario=scenario)
        self.model = kinematics(env.spec.embodiment)
        self.mouth = env.goal().target
        self.place = self.mouth + np.array([aside_m, 0.0, 0.0])
        above = self.model.goal_configurations_at_tool_angle(self.place + 0.004 * UP, UP, 0.0)
        self.set_point = above[np.abs(above).max(axis=1).argmin()]
        env.task.place(env.physics, self.set_point)

    def to(self, height_m: float) -> Any:
        """Send the tip to a height over the mouth (m); returns the time step."""
        near = self.model.nearest_configuration(
            self.set_point, self.place + height_m * UP, UP, JOINT_ACCELERATION_RAD_S2
        )
        assert near is not None
        self.set_point = near
        return self.env.step(self.env.commandable(near))

    def tip(self) -> FloatArray:
        return self.env.tip().position


def press(hand: Hand, height_m: float) -> Any:
    """Lower the set point to a height, half a millimetre a step, and let the arm come to rest."""
    for height in np.arange(0.003, height_m, -0.0005):
        hand.to(height)
    for _ in range(10):
        time_step = hand.to(height_m)
    return time_step


@pytest.mark.parametrize(("place", "n_at_rest"), [("face", 30), ("rim", 3)])
@pytest.mark.parametrize("task", TASKS)
def test_a_peg_held_against_face_or_rim_stays_at_rest_and_gains_no_energy(
    task: str, place: str, n_at_rest: int
) -> None:
    """At rest: to 0.01 mm for 100 steps of the physics (0.21 s), which 3 control steps hold.

    It is held for 100 control steps (10 s), longer than any episode presses. Over so long a time
    MuJoCo's soft friction lets a peg at the brink of slipping creep by more, but by less than
    0.1 mm; docs/experiments/insertion.md has the figures and the reason.
    """
    with hvs_suite.load(task, split="test", observations=BLIND, time_limit_steps=150) as env:
        env.draws = False
        catch_m = 0.001 * (env.spec.clearance_mm + env.spec.chamfer_mm)
        hand = Hand(env, 0.008 if place == "face" else catch_m + 0.001)
        press(hand, -0.003)
        start, energy = hand.tip(), energy_j(env)
        deepest, stay = 0.0, env.commandable(hand.set_point)
        for step in range(100):
            env.step(stay)
            deepest = min([deepest, *env.physics.data.contact.dist])
            moved = float(np.linalg.norm(hand.tip() - start))
            assert moved < (0.00001 if step < n_at_rest else 0.0001)
            before, energy = energy, energy_j(env)
            # Where contacts come and go it rises by what the solver leaves: of 14 mJ, 0.4 uJ.
            assert energy < before + 1e-6
        assert env.physics.data.ncon
        assert -MAX_PENETRATION_M < deepest < 0.0
        assert not env.info["collision"]


def energy_j(env: Environment) -> float:
    """What the joints' springs and the moving arm hold (J); its weight is made up for."""
    model, data = env.physics.model.ptr, env.physics.data.ptr
    mujoco.mj_energyVel(model, data)
    lead = env.setpoint - env.joint_positions
    return float(0.5 * model.actuator_gainprm[:, 0] @ lead**2 + data.energy[1])


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_a_peg_that_the_mouth_catches_goes_in_with_energy_from_nowhere_but_the_arm(
    env: Environment, share: float
) -> None:
    spec = env.spec
    hand = Hand(env, 0.001 * share * spec.clearance_mm)
    deepest, fastest = 0.0, 0.0
    for height in np.arange(0.004, -0.016, -0.001):
        time_step = hand.to(float(height))
        deepest = min([deepest, *env.physics.data.contact.dist])
        fastest = max(fastest, float(np.abs(env.joint_velocities).max()))
        if time_step.last():
            break
    assert env.info["is_success"]
    assert env.info["errors"][DEPTH] <= spec.depth_tolerance_mm
    assert deepest > -MAX_PENETRATION_M
    # The set point moves at 10 mm/s, which no joint has to turn faster for than this.
    assert fastest < 0.15


def test_pressing_beside_the_hole_is_felt_and_too_much_of_it_is_an_overload(
    env: Environment,
) -> None:
    limit = env.spec.force_limit_n
    hand = Hand(env, 0.008)
    assert np.abs(hand.to(0.003).observation[WRENCH][:3]).max() < 2.0
    time_step = press(hand, -0.002)
    # Down is the flange's z axis: the face pushes the other way.
    felt = -time_step.observation[WRENCH][2]
    assert 2.0 < felt < limit
    assert env.info["errors"][PEAK_FORCE] >= felt - 3.0
    assert not env.info["overload"]
    while not time_step.last():
        hand.place = hand.place - 0.002 * UP
        time_step = hand.to(-0.002)
    info = env.info
    assert info["overload"]
    assert info["collision"]
    assert not info["is_success"]
    assert time_step.discount == 0.0
    assert limit < info["errors"][PEAK_FORCE] < 2.0 * limit


def test_nothing_but_peg_and_bushing_may_touch(env: Environment) -> None:
    hand = Hand(env, 0.06)
    time_step = hand.to(0.003)
    while not time_step.last():
        hand.place = hand.place - 0.004 * UP
        time_step = hand.to(0.0)
    assert env.info["collision"]
    assert not env.info["overload"]
    assert env.info["errors"][PEAK_FORCE] == 0.0


def test_the_eye_in_hand_is_said_to_see_the_bushing_that_the_peg_stands_over(
    env: Environment,
) -> None:
    """It sits in a bracket, which its pictures do not show."""
    hand = Hand(env, aside_m=0.0)
    hand.set_point = hand.model.goal_configurations_at_tool_angle(hand.place + 0.05 * UP, UP, 0.0)[
        0
    ]
    env.task.place(env.physics, hand.set_point)
    u, v, diameter, seen = env.privileged()["target_eih"]
    assert seen == 1.0
    assert abs(u) < 0.1
    assert 0.15 < diameter < 0.3
    ids = env.physics.render(112, 112, camera_id=env.task.cameras["eih"].id, segmentation=True)
    rows, _ = np.nonzero(ids[..., 0] == env.task.family.marker_geom)
    assert rows.mean() == pytest.approx(0.5 * (v + 1.0) * 112, abs=2.0)


def test_the_hidden_error_is_in_no_observation_and_not_in_the_pictures() -> None:
    with hvs_suite.load("insert-feel", split="test") as env:
        seen = env.reset(scenario=3).observation
        offset = env.privileged()["goal_unseen"][:2]
        assert np.linalg.norm(offset) > 1e-4
        assert "goal_unseen" not in seen
        painted = env.task.family.keypoints()["target"].position
        np.testing.assert_allclose(env.goal().target[:2] - painted[:2], offset, atol=1e-12)
        everywhere = [env.task.source.draw(index).hole_offset for index in range(300)]
        assert np.abs(everywhere).max() <= 0.001
        assert 0.00035 < np.std(everywhere) < 0.0005
    with hvs_suite.load("insert-feel", split="test", force_limit_n=39.0) as env:
        other = env.reset(scenario=3)
        hole = env.task.family._peg._mocaps[1]
        env.physics.data.mocap_pos[hole] += [0.0005, -0.0005, 0.0]
        [moved] = env.pictures([env.moment()])["eih"]
        np.testing.assert_array_equal(moved, other.observation["eih"])


def test_the_wrench_has_the_tool_s_weight_taken_out_in_any_posture() -> None:
    options: dict[str, Any] = {"force_noise_n": 0.0, "torque_noise_nm": 0.0, "start": "random"}
    with hvs_suite.load("insert-wide", split="test", observations=BLIND, **options) as env:
        env.draws = False
        for scenario in range(3):
            env.reset(scenario=scenario)
            stay = env.commandable(env.setpoint)
            for _ in range(10):
                wrench = env.step(stay).observation[WRENCH]
            assert np.abs(wrench[:3]).max() < 0.01
            assert np.abs(wrench[3:]).max() < 0.001


def test_the_wrench_s_noise_depends_on_scenario_and_step_alone() -> None:
    with hvs_suite.load("insert-wide", split="test", observations=BLIND) as env:
        env.draws = False
        stay = np.zeros(7, np.float32)
        first = [env.reset(scenario=1).observation[WRENCH], env.step(stay).observation[WRENCH]]
        env.reset(scenario=2)
        again = [env.reset(scenario=1).observation[WRENCH], env.step(stay).observation[WRENCH]]
        np.testing.assert_array_equal(first, again)
        assert np.abs(first[0] - first[1]).min() > 0.0


def test_beside_the_bushing_no_depth_counts(env: Environment) -> None:
    env.reset(scenario=0)
    goal = env.goal()
    errors = env.task.family.measure(Tip(goal.position + np.array([0.01, 0.0, 0.0]), -UP))
    assert errors[DEPTH] == 0.0
    assert errors[LATERAL] > env.spec.step_bounds[LATERAL]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"clearance_mm": 0.01}, "clearance_mm is 0.01; use 0.05 .* to 14.0 mm"),
        ({"clearance_mm": 14.5}, "which a bushing of 40 mm leaves"),
        ({"chamfer_mm": 0.0}, "chamfer_mm is 0.0; it must be positive"),
        ({"goal_depth_m": 0.02}, "goal_depth_m is 0.02"),
        ({"hole_depth_m": 0.0005}, "deeper than its chamfer"),
        ({"peg_length_m": 0.6}, "cannot lift the peg over a bushing at a radius of 0.78 m"),
        ({"ring_m": (0.1, 0.2)}, "cannot lift the peg"),
        ({"stiffness": 2.0}, "stiffness is 2.0; it must lie between 0.01 and 1"),
        ({"physics_hz": 100}, "physics_hz is 100; it must be at least 240"),
        ({"physics_hz": 481}, "whole multiple of the physics timestep of 1/481 s"),
        ({"force_limit_n": 0.0}, "must be positive"),
        ({"hole_noise_mm": -0.1}, "cannot be negative"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.load("insert-wide", **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("n", [3, pytest.param(200, marks=pytest.mark.slow)])
def test_half_the_timestep_gives_the_same_outcome(n: int) -> None:
    same = 0
    with (
        hvs_suite.load("insert-feel", split="dev", observations="state") as whole,
        hvs_suite.load("insert-feel", split="dev", observations="state", physics_hz=960) as half,
    ):
        for scenario in range(n):
            played = run_episode(whole, make_expert(whole), scenario)
            actions = iter(played.actions)

            class Again:
                def reset(self) -> None: ...

                def select_action(self, observation: object) -> npt.NDArray[np.float32]:
                    return next(actions, played.actions[-1])  # noqa: B023

            same += run_episode(half, Again(), scenario).success == played.success
    assert same >= 0.98 * n
