"""``hvs train-sac``: the thesis's baseline, soft actor-critic from scratch."""

import dataclasses
import functools
from pathlib import Path

from hvs_suite.cli.rl_session import show_run
from hvs_suite.errors import OptionError
from hvs_suite.policies.sac.settings import EyeKind, Settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainSac:
    """Train a policy from scratch by soft actor-critic, with the thesis's settings.

    Trains for --minutes or --steps, whichever ends first, or for forty minutes if neither is given.
    If it was interrupted, the same command continues from the last checkpoint. Curves and a film of
    each evaluation are in OUT/training.

    Attributes:
        task: A named task, such as align-thesis.
        out: Folder for the policy, which hvs evaluate --policy takes.
        minutes: Stop after this much playing and learning, evaluations not counted (min).
        steps: Stop after this many environment steps.
        seed: Seed of weights, scenes, exploration and batches.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Episodes an evaluation, on scenes of a split of their own.
        reward: Reward term to learn from; give it several times for several terms. Without it, the
            thesis's five: goal, collision, time, position, rotation.
        learning_rate: Of actor, critics and temperature.
        batch_size: Transitions an update.
        replay_size: Transitions kept; 10000 at 112 px take 1.5 GB of memory.
        random_steps: Environment steps with random actions before learning starts.
        collect_steps: Environment steps an iteration.
        updates: Updates after each iteration.
        eyes: Networks of the images: apart, one each; shared, one for both; or pretrained, the eyes
            of the weights shipped for the task, which are not trained further.
        shared_trunk: Let actor and critics share the sub-networks of the inputs.
        guide: Policy that plays some of the episodes to learn from, such as expert.
        guide_share: Probability that an episode is the guide's.
        hidden_units: Width of each of the two dense layers behind the sub-networks.
        device: Where the networks are: cpu or cuda.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    task: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    eval_every: int = 10_000
    eval_episodes: int = 20
    reward: tuple[str, ...] = ()
    learning_rate: float = 3e-4
    batch_size: int = 256
    replay_size: int = 10_000
    random_steps: int = 10_000
    collect_steps: int = 20
    updates: int = 1
    eyes: EyeKind = "apart"
    shared_trunk: bool = False
    guide: str | None = None
    guide_share: float = 0.2
    hidden_units: int = 256
    device: str = "cpu"
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Train, showing how it goes, and say what came of it."""
        from hvs_suite import registry

        settings = Settings(
            learning_rate=self.learning_rate,
            batch_size=self.batch_size,
            replay_size=self.replay_size,
            random_steps=self.random_steps,
            collect_steps=self.collect_steps,
            updates=self.updates,
            hidden=(self.hidden_units, self.hidden_units),
            eyes=self.eyes,
            shared_trunk=self.shared_trunk,
        )
        # Before SB3 is imported, which takes seconds.
        options = registry.find(self.task).options_from_text(self.option)
        if "rewards" in options:
            raise OptionError("name the terms to learn from with --reward, not as an option")
        from hvs_suite.policies.catalogue import checkpoint_folder, demonstrator_factory
        from hvs_suite.policies.rl.guide import Guide
        from hvs_suite.policies.sac.training import train_sac
        from hvs_suite.tasks.shared.spec import THESIS_REWARDS

        guide = None
        if self.guide is not None:
            make = demonstrator_factory(self.guide, self.task, options)
            guide = Guide(self.guide, make, self.guide_share)
        show_run(
            functools.partial(train_sac, self.task, self.out),
            self.out,
            minutes=self.minutes,
            steps=self.steps,
            seed=self.seed,
            settings=settings,
            eyes_of=checkpoint_folder("pretrained", self.task)
            if self.eyes == "pretrained"
            else None,
            guide=guide,
            options=options,
            rewards=self.reward or THESIS_REWARDS,
            eval_every=self.eval_every,
            eval_episodes=self.eval_episodes,
            device=self.device,
        )
