"""The Gymnasium door: both checkers are content, and scenarios mean what they mean elsewhere."""

import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import hvs_suite
from hvs_suite.errors import ActionError, OptionError, ScenarioError, UnknownTaskError
from hvs_suite.gym import TaskEnv

ERRORS = ("position_error_mm", "lateral_error_mm", "height_error_mm", "tilt_error_deg")
HOLD = np.zeros(7, np.float32)
# Python warns of every fork; that ours is safe after drawing is tested in test_renderer.py.
may_fork = pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")


@pytest.fixture(scope="module")
def thesis():
    env = gymnasium.make("hvs_suite/align-thesis-v1", split="test", render_mode="rgb_array")
    yield env
    env.close()


class WithPhysics(gymnasium.Wrapper):
    """An environment that tells its physics state, which no observation shows in full."""

    def physics_state(self):
        """All that MuJoCo needs to go on from here, (n,) float64."""
        physics = self.unwrapped.environment.physics
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(physics.model.ptr, kind))
        mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, kind)
        return state


def same(first, second):
    """Whether two observations are equal, bit for bit."""
    return first.keys() == second.keys() and all(
        np.array_equal(first[name], second[name]) for name in first
    )


@pytest.mark.each_task
def test_gymnasium_finds_nothing_to_complain_about(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"hvs_suite/{task}-v1", render_mode="rgb_array")
        check_env(env.unwrapped)
        env.close()


@pytest.mark.each_task
def test_stable_baselines_finds_nothing_to_complain_about(task):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"hvs_suite/{task}-v1")
        checker.check_env(env.unwrapped, warn=True)
        env.close()


def test_observations_are_flat_and_within_their_space(thesis):
    observation, _ = thesis.reset(options={"scenario": 3})
    assert list(observation) == ["eih", "eth", "joint_positions", "joint_velocities"]
    assert observation["eih"].dtype == observation["eth"].dtype == np.uint8
    assert observation["joint_positions"].dtype == np.float32
    for space in thesis.observation_space.values():
        assert np.isfinite(space.low).all()
        assert np.isfinite(space.high).all()
    while True:
        assert thesis.observation_space.contains(observation)
        observation, _, terminated, truncated, _ = thesis.step(HOLD)
        if terminated or truncated:
            break


def test_info_holds_plain_python_values(thesis):
    for info in (thesis.reset(seed=0)[1], thesis.step(HOLD)[4]):
        plain = {bool, int, float, str, type(None)}
        assert {type(value) for name, value in info.items() if name != "errors"} <= plain
        assert type(info["is_success"]) is bool
        assert (info["task"], info["split"], info["scenario"]) == ("align-thesis", "test", 0)
        assert [*info["errors"]] == list(ERRORS)
        assert {type(value) for value in info["errors"].values()} == {float}


def test_the_time_limit_truncates_after_exactly_the_tasks_steps(thesis):
    thesis.reset(options={"scenario": 0})
    ends = [thesis.step(HOLD)[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]


def test_the_goal_terminates():
    from hvs_suite.datasets.expert import make_expert

    env = TaskEnv("align-easy")
    env.reset(options={"scenario": 0})
    expert = make_expert(env.environment)
    ended = False
    while not ended:
        _, reward, terminated, truncated, info = env.step(expert.label())
        ended = terminated or truncated
    assert (terminated, truncated, reward) == (True, False, 1.0)
    assert info["is_success"]
    env.close()


def test_a_collision_terminates_without_success():
    env = TaskEnv("align-easy")
    env.reset(options={"scenario": 0})
    down = np.array([0, 1, 0, 0, 0, 0, 0], np.float32)
    ended = False
    while not ended:
        _, _, terminated, truncated, info = env.step(down)
        ended = terminated or truncated
    assert (terminated, truncated) == (True, False)
    assert info["collision"]
    assert not info["is_success"]
    env.close()


def test_stepping_on_after_the_end_asks_for_a_reset(thesis):
    thesis.reset(options={"scenario": 0})
    for _ in range(20):
        thesis.step(HOLD)
    with pytest.raises(gymnasium.error.ResetNeeded):
        thesis.step(HOLD)


def test_out_of_range_actions_are_clipped_and_counted(thesis):
    thesis.reset(seed=1)
    assert thesis.step(0.01 * np.ones(7, np.float32))[4]["n_clipped"] == 0
    observation, *_, info = thesis.step(np.array([7.0, 0, 0, 0, 0, 0, 0], np.float32))
    assert info["n_clipped"] == 1
    thesis.reset(seed=1)
    thesis.step(0.01 * np.ones(7, np.float32))
    clipped, *_ = thesis.step(np.array([1.0, 0, 0, 0, 0, 0, 0], np.float32))
    assert same(observation, clipped)


@pytest.mark.parametrize(
    "action", [np.full(7, np.nan), np.full(7, np.inf), np.zeros(6), np.zeros((1, 7)), "left"]
)
def test_actions_that_mean_nothing_are_refused(thesis, action):
    thesis.reset(seed=1)
    with pytest.raises(ActionError):
        thesis.step(action)


def test_a_scenario_asked_for_by_index_is_the_one_that_load_plays(thesis):
    observation, info = thesis.reset(options={"scenario": 12, "unknown": "tolerated"})
    with hvs_suite.load("align-thesis", split="test") as env:
        time_step = env.reset(scenario=12)
        assert np.array_equal(observation["eth"], time_step.observation["eth"])
    assert info["scenario"] == 12


def test_a_seed_plays_the_scenario_of_that_index_modulo_the_split(thesis):
    assert thesis.reset(seed=1007)[1]["scenario"] == 7
    stream = [thesis.reset()[1]["scenario"] for _ in range(3)]
    thesis.reset(seed=1007)
    assert [thesis.reset()[1]["scenario"] for _ in range(3)] == stream
    thesis.reset(seed=8)
    assert [thesis.reset()[1]["scenario"] for _ in range(3)] != stream


def test_unknown_scenarios_tasks_and_options_are_refused(thesis):
    with pytest.raises(ScenarioError):
        thesis.reset(options={"scenario": 1000})
    with pytest.raises(UnknownTaskError, match="align-thesis"):
        TaskEnv("align-thesi")
    with pytest.raises(OptionError):
        gymnasium.make("hvs_suite/align-easy-v1", no_such_option=1)
    with pytest.raises(gymnasium.error.NameNotFound, match="align-thesis"):
        gymnasium.make("hvs_suite/align-thesi-v1")
    with pytest.raises(OptionError, match="eih_resolution is 0 px"):
        gymnasium.make("hvs_suite/align-easy-v1", eih_resolution=0)
    with pytest.raises(OptionError, match="both cameras off"):
        gymnasium.make("hvs_suite/align-easy-v1", observations="joint_positions")
    with pytest.raises(gymnasium.error.UnsupportedMode):
        TaskEnv("align-easy", render_mode="human")


def test_render_draws_the_cell_once_a_step_and_hands_out_copies(thesis):
    thesis.reset(seed=0)
    frame = thesis.render()
    assert frame.shape == (480, 480, 3)
    assert frame.dtype == np.uint8
    frame[:] = 0
    assert thesis.render().any()


def test_observations_share_no_memory(thesis):
    first, _ = thesis.reset(seed=0)
    kept = {name: value.copy() for name, value in first.items()}
    second, *_ = thesis.step(0.1 * np.ones(7, np.float32))
    assert not any(np.shares_memory(first[name], second[name]) for name in first)
    assert same(first, kept)


def test_closing_twice_does_nothing():
    env = TaskEnv("align-easy")
    env.reset(seed=0)
    env.close()
    env.close()


def test_options_of_the_task_are_keywords():
    env = gymnasium.make("hvs_suite/align-easy-v1", action_mode="flange_twist", time_limit_steps=3)
    assert env.action_space.shape == (6,)
    env.reset(seed=0)
    assert [env.step(np.zeros(6, np.float32))[3] for _ in range(3)] == [False, False, True]
    env.close()


@may_fork
@pytest.mark.timeout(300)
@pytest.mark.each_task
def test_a_scenario_asked_for_by_index_is_the_same_in_any_worker(task):
    """Whatever the worker played before, and bit for bit: pictures, joints and physics."""
    workers = gymnasium.make_vec(
        f"hvs_suite/{task}-v1",
        num_envs=4,
        vectorization_mode="async",
        split="test",
        wrappers=[WithPhysics],
    )
    alone = WithPhysics(TaskEnv(task, split="test"))
    try:
        workers.reset(seed=500)
        workers.step(np.random.default_rng(0).uniform(-0.05, 0.05, (4, 7)).astype(np.float32))
        expected, _ = alone.reset(options={"scenario": 23})
        observations, info = workers.reset(options={"scenario": 23})
        assert info["scenario"].tolist() == [23] * 4
        for step in range(3):
            state = alone.physics_state()
            for i, found in enumerate(workers.call("physics_state")):
                np.testing.assert_array_equal(found, state)
                assert same(expected, {name: value[i] for name, value in observations.items()})
            action = np.full((4, 7), 0.01 * step, np.float32)
            expected, *_ = alone.step(action[0])
            observations, *_ = workers.step(action)
    finally:
        workers.close()
        alone.close()


@may_fork
@pytest.mark.timeout(300)
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_workers_play_the_scenarios_they_are_asked_for(thesis, context):
    workers = gymnasium.make_vec(
        "hvs_suite/align-thesis-v1",
        num_envs=4,
        vectorization_mode="async",
        split="test",
        vector_kwargs={"context": context},
    )
    try:
        observations, info = workers.reset(seed=40)
        assert info["scenario"].tolist() == [40, 41, 42, 43]
        alone, _ = thesis.reset(options={"scenario": 42})
        assert same(alone, {name: value[2] for name, value in observations.items()})
        seen = [set(), set(), set(), set()]
        for _ in range(21):
            observations, _, _, _, info = workers.step(np.zeros((4, 7), np.float32))
            for scenes, scenario in zip(seen, info["scenario"].tolist(), strict=True):
                scenes.add(scenario)
        # The 21st step was an autoreset: each worker went on in a stream of its own.
        assert all(len(scenes) == 2 for scenes in seen)
        assert len(set.union(*seen)) == 8
    finally:
        workers.close()


def test_the_spec_says_when_an_episode_ends():
    from gymnasium.wrappers import TimeAwareObservation

    for limit, options in ((20, {}), (7, {"time_limit_steps": 7}), (4, {"max_episode_steps": 4})):
        env = gymnasium.make("hvs_suite/align-thesis-v1", observations="state", **options)
        assert env.spec.max_episode_steps == limit
        timed = TimeAwareObservation(env, flatten=False)
        timed.reset(seed=0)
        steps = [timed.step(HOLD) for _ in range(limit)]
        assert [step[3] for step in steps] == [False] * (limit - 1) + [True]
        assert steps[-1][0]["time"] == limit
        timed.close()


def test_a_limit_that_the_environment_would_not_reach_is_refused():
    with pytest.raises(OptionError, match="use time_limit_steps=40"):
        gymnasium.make("hvs_suite/align-thesis-v1", max_episode_steps=40)


@pytest.mark.each_task(measures="position_error_mm")
def test_both_checkers_are_content_with_every_goal_environment(task):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"hvs_suite/{task}-goal-v1").unwrapped
        checker.check_env(env)
        check_env(env)
        env.close()


def test_a_goal_environment_rewards_any_tip_at_any_goal():
    from hvs_suite.datasets.expert import make_expert

    env = gymnasium.make("hvs_suite/align-easy-goal-v1").unwrapped
    first, _ = env.reset(options={"scenario": 0})
    expert = make_expert(env.environment)
    ended, rewards = False, []
    while not ended:
        observation, reward, terminated, truncated, info = env.step(expert.label())
        rewards.append(reward)
        ended = terminated or truncated
    assert info["is_success"]
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    achieved = np.stack([first["achieved_goal"], observation["achieved_goal"]])
    there, beside = achieved.copy(), achieved.copy()
    beside[:, 0] += 0.006  # The task allows 5 mm.
    desired = np.repeat(observation["desired_goal"][None], 2, axis=0)
    nothing = [{}, {}]
    assert env.compute_reward(achieved, desired, nothing).tolist() == [0.0, 1.0]
    assert env.compute_reward(achieved, there, nothing).tolist() == [1.0, 1.0]
    assert env.compute_reward(achieved, beside, nothing).tolist() == [0.0, 0.0]
    assert env.compute_reward(achieved, there, [{"collision": True}, {}]).tolist() == [0.0, 1.0]
    env.close()


def test_hindsight_replay_of_stable_baselines_learns_from_what_was_reached():
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make("hvs_suite/align-easy-goal-v1")
    model = sb3.SAC(
        "MultiInputPolicy", env, replay_buffer_class=sb3.HerReplayBuffer, learning_starts=50, seed=0
    )
    model.learn(60)
    assert not model.replay_buffer.rewards.any()
    assert model.replay_buffer.sample(256).rewards.sum() > 0
    env.close()


def test_a_goal_environment_refuses_what_it_would_ignore():
    for name in ("observations", "rewards"):
        with pytest.raises(OptionError, match=name):
            gymnasium.make("hvs_suite/align-easy-goal-v1", **{name: "state"})


def test_record_video_films_an_episode(tmp_path):
    from gymnasium.wrappers import RecordVideo

    env = gymnasium.make("hvs_suite/align-easy-v1", render_mode="rgb_array", time_limit_steps=3)
    env = RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True)
    env.reset(seed=0)
    while not env.step(HOLD)[3]:
        pass
    env.close()
    [film] = tmp_path.glob("*.mp4")
    assert film.stat().st_size > 1000
