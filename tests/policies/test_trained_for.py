"""What a policy was trained for: written down, and held against every task that it is to play."""

import json
import shutil
from pathlib import Path

import miniature
import pytest

from hvs_suite.cli.main import run
from hvs_suite.errors import PolicyError
from hvs_suite.eval.scoring import result_file
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.checkpoints.card import write_card
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.trained_for import check_trained_for, trained_for
from hvs_suite.registry import TASKS

TASK = "align-easy"
TILTED = ["--option", "surface=tilted"]


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy trained on a tilted surface, for a step."""
    data, out = (tmp_path_factory.mktemp("tilted") / name for name in ("data", "policy"))
    columns = miniature.scene(8, side=112)
    miniature.write_dataset(data, columns, miniature.episodes(8), options={"surface": "tilted"})
    pretrain(data, out, steps=1, batch_size=4)
    return out


def evaluated(policy: Path | str, out: Path, *words: str) -> int:
    score = ["evaluate", "--policy", str(policy), "--task", TASK, "--episodes", "1"]
    return run([*score, "--out", str(out), *words])


def test_the_options_of_the_training_are_in_checkpoint_notes_and_card(tilted: Path) -> None:
    options = {"surface": "tilted"}
    assert json.loads((tilted / "config.json").read_text())["options"] == options
    assert json.loads((tilted / "train_config.json").read_text())["options"] == options
    assert "`align-easy` with `surface=tilted`" in write_card(tilted)


def test_a_policy_plays_with_the_options_of_its_training_alone(
    tilted: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result.json"
    assert evaluated(tilted, out) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "trained with surface=tilted, the task is played with surface as named" in said
    for flat in (checkpoint, "pretrained"):
        assert evaluated(flat, out, *TILTED) == 2
        said = capsys.readouterr().err
        assert "trained with surface as named, the task is played with surface=tilted" in said
    assert not out.exists()
    assert evaluated(tilted, out, *TILTED) == 0
    assert result_file.load(out).metadata.options == {"surface": "tilted"}
    capsys.readouterr()
    assert run(["ship", str(tilted), "--to-folder", str(tmp_path / "s"), "--result", str(out)]) == 0
    assert (
        "| `align-easy` with `surface=tilted` | `test` |" in (tmp_path / "s/README.md").read_text()
    )
    # Every other way to play it asks the same.
    film = str(tmp_path / "film.gif")
    assert run(["view", TASK, "--policy", str(tilted), "--out", film]) == 2
    words = ["finetune", "--policy", str(tilted), "--task", TASK, "--steps", "1"]
    assert run([*words, "--out", str(tmp_path / "tuned")]) == 2
    assert capsys.readouterr().err.count("trained with surface=tilted") == 2


def test_what_leaves_the_lesson_as_it_is_may_differ(tilted: Path, checkpoint: Path) -> None:
    for options in (
        {"start": "random"},
        {"position_tolerance_mm": 0.5, "hold_steps": 3},
        {"image_noise": 8.0, "vary_light": True},
        {"time_limit_steps": 40, "rewards": ["goal", "time"]},
    ):
        policy_factory(str(checkpoint), TASK, options)
        policy_factory(str(tilted), TASK, {**options, "surface": "tilted"})
        with pytest.raises(PolicyError, match="surface"):
            policy_factory(str(tilted), TASK, options)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"family": "shelf"}, "for the family shelf, the task is of align"),
        ({"control_period_s": 0.05}, "for control steps of 0.05 s, those of the task take 0.1 s"),
        ({"options": {"latency_steps": 1}}, "trained with latency_steps=1"),
        ({"options": {"ring_m": [0.5, 0.6]}}, "trained with ring_m=0.5,0.6"),
    ],
)
def test_another_family_period_or_option_is_named(
    checkpoint: Path, tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    folder = tmp_path / "policy"
    shutil.copytree(checkpoint, folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, **change}))
    with pytest.raises(PolicyError, match=reason):
        policy_factory(str(folder), TASK)


def test_other_people_s_policies_are_taken_at_their_inputs_and_old_ones_for_align() -> None:
    changed = TASKS[TASK].with_options({"surface": "tilted"})
    check_trained_for({"type": "act"}, Path("theirs"), changed)
    with pytest.raises(PolicyError, match="surface"):
        check_trained_for({"type": "hvs"}, Path("old"), changed)
    check_trained_for({"type": "hvs"}, Path("old"), TASKS[TASK])
    assert trained_for(changed).options == {"surface": "tilted"}
