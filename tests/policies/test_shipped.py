"""Shipped weights are the ones that were scored, they play, and their card says how they do."""

from pathlib import Path

import pytest
import scipy.stats

import hvs_suite
from hvs_suite.errors import PolicyError
from hvs_suite.eval.scoring import provenance, result_file
from hvs_suite.policies import catalogue
from hvs_suite.policies.recipe import recipe
from hvs_suite.rollout import rollout

RESULTS = Path(__file__).parents[2] / "eval" / "results"
SHIPPED = [
    (kind, task)
    for kind in catalogue.SHIPPED
    for task in hvs_suite.TASKS
    if catalogue.shipped_folder(kind, task).is_dir()
]


class Load:
    """Loads a task in whichever process asks for it."""

    def __init__(self, task: str) -> None:
        self.task = task

    def __call__(self):
        return hvs_suite.load(self.task, split="dev")


# Three scenes say little of weights that lose many.
@pytest.mark.parametrize(("few", "more"), [(3, 10), pytest.param(20, 20, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("kind", "task"), SHIPPED)
def test_shipped_weights_solve_scenes_that_nobody_trained_on(kind, task, few, more):
    make = catalogue.policy_factory(kind, task)
    summary = result_file.load(RESULTS / kind / f"{task}.json").summary
    n = few if summary.pc_success >= 90.0 else more
    episodes = rollout(Load(task), make, range(n))
    # Fewer solved than this, or more collisions, happens once in fifty times to weights that are as
    # good as the board says.
    usual = scipy.stats.binom.ppf(0.02, n, summary.n_success / summary.n_episodes)
    assert sum(episode.success for episode in episodes) >= min(0.8 * n, usual)
    most = scipy.stats.binom.ppf(0.98, n, summary.n_collision / summary.n_episodes)
    assert sum(episode.collision for episode in episodes) <= most


@pytest.mark.parametrize(("kind", "task"), SHIPPED)
def test_the_board_and_the_card_speak_of_these_weights(kind, task):
    folder = catalogue.shipped_folder(kind, task)
    result = result_file.load(RESULTS / kind / f"{task}.json")
    assert result.metadata.policy_hash == provenance.checkpoint_hash(folder)
    summary = result.summary
    row = f"| `{task}` | `test` | {summary.n_success:,} of {summary.n_episodes:,}"
    assert row in (folder / "README.md").read_text()


def test_fine_tuned_weights_serve_the_task_alone_on_which_they_are_better():
    imitated, tuned = (catalogue.shipped_folder(kind, "track-line") for kind in catalogue.SHIPPED)
    assert imitated == catalogue.shipped_folder("pretrained", "track-curve")
    assert catalogue.shipped_folder("finetuned", "track-curve").is_dir()
    assert not tuned.is_dir()
    with pytest.raises(PolicyError, match="no finetuned weights for track-line"):
        catalogue.policy_factory("finetuned", "track-line")
    assert recipe("track-curve").finetune
    assert recipe("track-line").finetune is None
