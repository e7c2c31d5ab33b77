"""``zero``, the floor of the board: it plays every step there is, and meets nothing."""

import pytest

import hvs_suite
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.rollout import run_episode


@pytest.mark.parametrize("n", [10, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", hvs_suite.TASKS)
def test_zero_ends_after_exactly_the_task_s_number_of_steps(task, n):
    with hvs_suite.load(task, split="test", observations="state") as env:
        zero = policy_factory("zero", task)(env)
        episodes = [run_episode(env, zero, index) for index in range(n)]
    assert {episode.steps for episode in episodes} == {hvs_suite.TASKS[task].time_limit_steps}
    assert all(episode.truncated for episode in episodes)
    assert not any(episode.success or episode.collision for episode in episodes)
