"""What is to be done differs from scene to scene: everybody who plays or learns is told."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import hvs_suite
from hvs_suite.datasets import reader
from hvs_suite.datasets.check import check_dataset
from hvs_suite.datasets.recorder import record
from hvs_suite.eval.scoring.trial import PlayTrial
from hvs_suite.eval.serving import wire
from hvs_suite.eval.serving.policy_session import Session
from hvs_suite.eval.serving.remote_policy import hello
from hvs_suite.gym import PixelsAgentPos, TaskEnv
from hvs_suite.rollout import Observation, run_episode
from hvs_suite.tasks.shared.things import COLOURS

TASK = "clutter-choice"
SMALL: dict[str, Any] = {"eih_resolution": 16, "eth_resolution": 16}
EPISODES = 6


class Listener:
    """A policy that stands still, and keeps what it is told and shown first."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.shown: list[str] = []
        self._is_new = True

    def instruct(self, sentence: str) -> None:
        self.told.append(sentence)

    def reset(self) -> None:
        self._is_new = True

    def select_action(self, observation: Observation) -> Any:
        if self._is_new:
            self.shown.append(COLOURS[int(observation["goal_colour"].argmax())])
            self._is_new = False
        return np.zeros(7, np.float32)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("choice") / "data"
    record(TASK, EPISODES, "train", root, SMALL, block=2)
    return root


def test_a_policy_that_listens_hears_what_it_is_shown() -> None:
    listener = Listener()
    with hvs_suite.load(TASK, split="test", time_limit_steps=1, **SMALL) as env:
        play = PlayTrial(salt="", decision_limit_s=60.0)
        for scenario in range(3):
            run_episode(env, listener, scenario)
            play(env, listener, scenario + 3)
        for told, colour in zip(listener.told, listener.shown, strict=True):
            assert f"the {colour} disc" in told
        assert len(set(listener.told)) >= 2


def test_gymnasium_and_lerobot_say_what_the_episode_is_about() -> None:
    env = PixelsAgentPos(TaskEnv(TASK, split="test", **SMALL))
    said = set()
    for scenario in range(5):
        observation, _ = env.reset(options={"scenario": scenario})
        colour = COLOURS[int(observation["goal_colour"].argmax())]
        sentence = env.get_wrapper_attr("task_description")
        assert f"the {colour} disc" in sentence
        said.add(sentence)
        assert env.observation_space.contains(observation)
    assert len(said) >= 2
    env.close()


def test_a_dataset_keeps_a_sentence_an_episode(recorded: Path) -> None:
    sentences = reader.read_sentences(recorded)
    assert len(set(sentences)) == len(sentences) >= 2
    assert reader.read_info(recorded)["total_tasks"] == len(sentences)
    rows = [
        row
        for file in sorted((recorded / "meta/episodes").rglob("*.parquet"))
        for row in pq.read_table(file, columns=["episode_index", "tasks"]).to_pylist()
    ]
    listed = {row["episode_index"]: row["tasks"] for row in rows}
    with hvs_suite.load(TASK, split="train", **SMALL) as env:
        for place in reader.read_places(recorded):
            table = reader.read_episode(recorded, place)
            env.reset(scenario=place.episode)
            numbers = set(reader.column(table, "task_index").ravel().tolist())
            assert [sentences[number] for number in numbers] == [env.instruction]
            assert listed[place.episode] == [env.instruction]
            meant = reader.column(table, "observation.goal_colour")
            assert (meant == env.observation_spec()["goal_colour"].maximum).sum() == len(meant)
            assert f"the {COLOURS[int(meant[0].argmax())]} disc" in env.instruction
    assert check_dataset(recorded).damage == ()


def test_a_recording_that_goes_on_numbers_its_sentences_as_one_that_was_never_stopped(
    recorded: Path, tmp_path: Path
) -> None:
    for episodes in (1, 3, EPISODES):
        record(TASK, episodes, "train", tmp_path, SMALL, block=2, resume=True)
    assert reader.read_sentences(tmp_path) == reader.read_sentences(recorded)
    for one, other in zip(reader.read_places(tmp_path), reader.read_places(recorded), strict=True):
        tables = reader.read_episode(tmp_path, one), reader.read_episode(recorded, other)
        numbers = [reader.column(table, "task_index") for table in tables]
        np.testing.assert_array_equal(*numbers)


def test_sentences_that_were_exchanged_are_damage(recorded: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(recorded, copy)
    table = pq.read_table(copy / reader.TASKS)
    sentences = table["task"].to_pylist()
    swapped = [sentences[1], sentences[0], *sentences[2:]]
    column = table.schema.get_field_index("task")
    pq.write_table(table.set_column(column, "task", [swapped]), copy / reader.TASKS)
    # Their order is LeRobot's tools' affair; which of them a frame names is not.
    assert any("task_index" in each.what for each in check_dataset(copy).damage)


def test_a_policy_at_the_other_end_of_a_line_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    session = Session("zero")
    with hvs_suite.load(TASK, split="test", **SMALL) as env:
        greeting = hello(TASK, env)
    session._policy = listener
    message = {"type": "reset", "seed": 1, "instruction": "Do this."}
    answer = wire.decode(session.answer(wire.encode(message)))
    assert answer["type"] == "done"
    assert listener.told == ["Do this."]
    assert greeting["instruction"] == hvs_suite.TASKS[TASK].instruction()
