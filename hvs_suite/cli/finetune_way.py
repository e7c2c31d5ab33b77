"""``hvs finetune-way``: a pretrained policy, made to go to its goal sooner by policy search."""

import dataclasses
from pathlib import Path

from hvs_suite.cli.players import Players
from hvs_suite.cli.rl_session import show_finetuning
from hvs_suite.policies.residual.way_settings import WaySettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinetuneWay(Players):
    """Fine-tune how a pretrained policy goes to its goal, by policy search.

    Learns by CMA-ES how to choose, far from the goal, among the steps that the policy weighs, for
    tasks in which it arrives late. All that is asked is how many control steps end outside the
    tolerances. Begins generations for --minutes or --steps, whichever ends first, or for forty
    minutes if neither is given; ends early if success falls, and keeps what was evaluated best.
    Interrupted, it goes on after its last generation when the same command is given again. Curves
    and a film of each evaluation are in OUT/training.

    Attributes:
        policy: Checkpoint of an hvs policy, as hvs pretrain makes it, or pretrained for the weights
            shipped for the task.
        task: A named task, such as track-hard.
        out: Folder for the checkpoint.
        minutes: Begin no generation after this much playing, evaluations not counted (min).
        steps: Begin no generation after this many environment steps.
        seed: Of candidates and scenes.
        population: Candidates a generation.
        scenes: Scenes that each of them plays.
        spread: Standard deviation of the first candidates, as a share of the largest shift.
        penalty: What the sum of squared weights costs (control steps).
        patience_steps: What a scene costs in which the tip does not arrive at a lone goal (control
            steps).
        reach_m: From which distance to the believed goal the way is learned (m).
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Episodes an evaluation, on scenes of a split of their own.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    policy: str
    task: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    population: int = WaySettings.population
    scenes: int = WaySettings.scenes
    spread: float = WaySettings.spread
    penalty: float = WaySettings.penalty
    patience_steps: int = WaySettings.patience_steps
    reach_m: float = WaySettings.reach_m
    eval_every: int = 100_000
    eval_episodes: int = 100
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Search, showing how it goes, and say what came of it."""
        # Only now, because it imports torch.
        from hvs_suite.policies.residual.search import search

        show_finetuning(self, WaySettings, search, workers=self.players(local=2))
