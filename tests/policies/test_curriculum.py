"""The curriculum: easier levels first, the next one once most episodes succeed."""

import gymnasium
import numpy as np
import pytest

from hvs_suite.datasets.expert import Expert
from hvs_suite.errors import OptionError, UnknownTaskError
from hvs_suite.policies.rl.curriculum import Curriculum, levels_of
from hvs_suite.registry import TASKS

STATE = {"observations": "state", "split": "train"}


def play(env, scenario):
    """Plays a scene with the expert."""
    env.reset(options={"scenario": scenario})
    expert, over = Expert(env.unwrapped.environment), False
    while not over:
        _, _, terminated, truncated, info = env.step(expert.label())
        over = terminated or truncated
    return info


def give_up(env, scenario):
    """Plays a scene without moving."""
    env.reset(options={"scenario": scenario})
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(np.zeros(7, np.float32))
        over = terminated or truncated
    return info


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.parametrize("kind", ["tolerance", "start"])
def test_levels_end_at_the_task_itself(task, kind):
    levels = levels_of(task, kind)
    assert len(levels) >= 3
    last = {name: getattr(TASKS[task], name) for name in levels[-1]}
    assert levels[-1] == last
    if kind == "tolerance":
        widths = [level["tilt_tolerance_deg"] for level in levels]
        assert widths == sorted(widths, reverse=True)


def test_success_leads_to_the_next_level_and_failure_does_not():
    levels = levels_of("align-thesis", "tolerance")[-2:]
    env = Curriculum("align-thesis", levels, threshold=0.5, window=2, time_limit_steps=18, **STATE)
    assert give_up(env, 0)["level"] == 0
    assert give_up(env, 1)["level"] == 0
    assert play(env, 2)["level"] == 0
    assert env.unwrapped.environment.spec.position_tolerance_mm == 2.0
    # One of the last two was solved, which is half.
    assert play(env, 3)["level"] == 1
    assert env.unwrapped.environment.spec.position_tolerance_mm == 1.0
    play(env, 4)
    assert play(env, 5)["level"] == 1  # the last one
    env.close()


def test_it_goes_on_where_it_stood():
    levels = levels_of("align-easy", "start")
    one = Curriculum("align-easy", levels, threshold=1.0, window=2, **STATE)
    for scenario in range(3):
        play(one, scenario)
    other = Curriculum("align-easy", levels, threshold=1.0, window=2, **STATE)
    other.load_state_dict(one.state_dict())
    assert other.state_dict() == one.state_dict()
    assert other.level == 1
    seen = [env.reset(options={"scenario": 7}) for env in (one, other)]
    for name, value in seen[0][0].items():
        np.testing.assert_array_equal(seen[1][0][name], value)
    one.close()
    other.close()


def test_it_is_a_gymnasium_environment_like_the_task():
    plain = gymnasium.make("hvs_suite/align-easy-v1", **STATE)
    env = Curriculum("align-easy", levels_of("align-easy", "tolerance"), **STATE)
    assert env.observation_space == plain.observation_space
    assert env.action_space == plain.action_space
    plain.close()
    env.close()


def test_nonsense_is_refused():
    with pytest.raises(OptionError, match="level"):
        Curriculum("align-easy", [], **STATE)
    with pytest.raises(OptionError, match="threshold"):
        Curriculum("align-easy", [{}], threshold=0.0, **STATE)
    with pytest.raises(OptionError, match="curriculum"):
        levels_of("align-easy", "height")
    with pytest.raises(UnknownTaskError):
        levels_of("align-nothing", "start")
