"""How shipped weights are made: every named task's commands are there, and ``hvs`` takes them."""

from pathlib import Path

import pytest

import hvs_suite
from hvs_suite.cli.main import parse, run
from hvs_suite.policies.recipe import HERE, recipe, trained_on

RECIPES = {path.stem for path in (HERE / "recipes").iterdir()}
NOT_SHIPPED = [task for task in hvs_suite.TASKS if trained_on(task) not in RECIPES]


def test_weights_are_shipped_with_a_recipe_each():
    shipped = {path.name for path in (HERE / "pretrained").iterdir()}
    assert shipped == RECIPES <= set(hvs_suite.TASKS)


@pytest.mark.parametrize("task", sorted(t for t in hvs_suite.TASKS if trained_on(t) in RECIPES))
def test_a_recipe_trains_on_what_it_records(task):
    plan = recipe(task)
    record, pretrain = parse(plan.record), parse(plan.pretrain)
    assert record.task == plan.task == trained_on(task)
    assert pretrain.data == record.out
    assert pretrain.steps
    recorded, learned = {record.out}, set()
    for words in (*plan.earlier, plan.pretrain):
        made = parse(words)
        if words[0] == "record":
            recorded.add(made.out)
            continue
        assert made.data in recorded
        begins_with = {*made.eyes, *filter(None, [made.weights])}
        for name in begins_with - learned:
            assert (HERE / "pretrained" / name).is_dir()
        # What was learned before is of use: the next goes on from it.
        assert not learned or begins_with & learned
        learned.add(str(made.out))
    if plan.finetune is not None:
        finetune = parse(plan.finetune)
        assert (Path(finetune.policy), finetune.task) == (pretrain.out, plan.task)
        assert finetune.out != pretrain.out
        assert finetune.steps


@pytest.mark.parametrize("task", sorted(hvs_suite.TASKS))
def test_a_shared_policy_sees_what_its_own_task_shows(task):
    one, other = hvs_suite.TASKS[task], hvs_suite.TASKS[trained_on(task)]
    for name in ("eih_resolution", "eth_resolution", "observations", "target_diameter_m"):
        assert getattr(one, name) == getattr(other, name)


@pytest.mark.parametrize(
    "words",
    [
        ["--task", "align-nothing"],
        ["--task", "align-easy", "--episodes", "0"],
        *(["--task", task] for task in NOT_SHIPPED[:1]),
    ],
)
def test_nonsense_is_one_line(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["reproduce", *words]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not list(tmp_path.iterdir())
