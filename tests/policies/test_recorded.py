"""What training takes for the truth: the goal as a robot that believes its encoders sees it."""

import numpy as np

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.datasets.features import STATE, observed_part
from hvs_suite.policies.belief.recorded import shown_goals
from hvs_suite.policies.training.dataset import (
    GOAL_NORMAL,
    GOAL_POSITION,
    GOAL_UNSEEN,
    JOINT_OFFSET,
)


def test_without_errors_of_the_encoders_goals_are_where_they_are() -> None:
    columns = {
        GOAL_POSITION: np.array([[0.4, 0.1, 0.2]], np.float32),
        GOAL_NORMAL: np.array([[0.0, 0.6, 0.8]], np.float32),
    }
    position, normal = shown_goals(columns)
    np.testing.assert_array_equal(position, columns[GOAL_POSITION])
    np.testing.assert_array_equal(normal, columns[GOAL_NORMAL])


def test_a_hole_that_is_not_where_its_paint_is_counts_as_where_the_paint_is() -> None:
    env = hvs_suite.load("insert-feel", split="dev")
    frame = observed_part(env.spec, env.reset(scenario=0).observation, env)
    columns = {key: frame[key][None] for key in (GOAL_POSITION, GOAL_NORMAL, GOAL_UNSEEN)}
    [position], _ = shown_goals(columns)
    painted = env.task.family.keypoints()["target"].position
    np.testing.assert_allclose(position[:2], painted[:2], atol=1e-6)
    assert np.abs(frame[GOAL_POSITION][:2] - painted[:2]).max() > 1e-4


def test_an_arm_that_is_at_its_goal_is_there_by_its_encoders_too() -> None:
    random = np.random.default_rng(0)
    q = random.uniform(-1.5, 1.5, (20, 7))
    offset = np.radians(random.normal(0.0, 0.05, (20, 7)))
    true, shown = ([kinematics().flange_pose(each) for each in a] for a in (q, q + offset))
    columns = {
        STATE: np.concatenate([q + offset, np.zeros((20, 7))], axis=1),
        JOINT_OFFSET: offset,
        GOAL_POSITION: np.array([place for _, place in true]),
        GOAL_NORMAL: np.array([-rotation[:, 2] for rotation, _ in true]),
    }
    position, normal = shown_goals(columns)
    np.testing.assert_allclose(position, np.array([place for _, place in shown]), atol=1e-9)
    np.testing.assert_allclose(normal, np.array([-R[:, 2] for R, _ in shown]), atol=1e-9)
    assert np.abs(position - columns[GOAL_POSITION]).max() > 5e-4


def test_a_recording_says_how_wrong_the_encoders_are() -> None:
    env = hvs_suite.load("align-drill", split="dev")
    observation = env.reset(scenario=0).observation
    frame = observed_part(env.spec, observation, env)
    true = frame[STATE][:7] - frame[JOINT_OFFSET]
    np.testing.assert_allclose(true, env.privileged()["joint_positions"], atol=1e-6)
    assert np.abs(frame[JOINT_OFFSET]).max() > 1e-4
