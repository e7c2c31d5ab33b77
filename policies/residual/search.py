"""Fine-tuning of the way to the goal: policy search on what `Choice` weighs by, top to bottom.

An episode's return is all that is asked; no expert and no gradient. Evolution by covariance matrix
adaptation (Hansen, 2016, https://arxiv.org/abs/1604.00772) draws some candidates a generation. They
all play the same scenes, so that what differs between scenes does not hide what differs between
candidates. A run is a function of base, task, settings, seed and number of steps; killed, it goes
on after its last generation when the same command is given again.
"""

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from cmaes import CMA

from hvs_suite.executor import Make, Note, Workers, size, spread
from hvs_suite.files import replacing
from hvs_suite.policies.belief.acting import CompiledBelief
from hvs_suite.policies.belief.network import BeliefNetwork
from hvs_suite.policies.catalogue import name_of
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import network_inputs
from hvs_suite.policies.residual.folding import load_base, with_choice, write_folded
from hvs_suite.policies.residual.session import begin, evaluate_and_keep, is_due
from hvs_suite.policies.residual.way_settings import WaySettings
from hvs_suite.policies.rl.evaluation import Evaluator, fallen, read_evaluations
from hvs_suite.policies.rl.outcome import Outcome, Progress
from hvs_suite.policies.rl.plot import draw_rl_run
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.curves import Curves
from hvs_suite.policies.training.run_folder import claimed, write_train_config
from hvs_suite.registry import load
from hvs_suite.rollout import carried, one_torch_thread

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

PACKAGES = ("cmaes", "hvs-suite", "mujoco", "numpy", "torch")
SCENES_A_SEED = 10**9
"""Runs with different seeds learn from different scenes."""
SETTLED_STEPS = 5
"""For so long a lone goal has to be held to count as arrived at, or for as long as the task wants
it to be, if that is shorter."""


def search(
    policy: Path,
    task: str,
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    settings: WaySettings | None = None,
    options: Mapping[str, Any] | None = None,
    split: str = "train",
    workers: Workers = 1,
    eval_every: int = 100_000,
    eval_episodes: int = 100,
    on_progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Make a policy go to its goal sooner.

    Args:
        policy: Checkpoint of an `hvs` policy.
        task: Named task.
        out: Folder for the checkpoint, an `hvs` policy like the base; the state of the search
            lives in ``out/training``.
        minutes: Begin no generation after this much playing, evaluations not counted (min).
        steps: Begin no generation after this many environment steps. Give either, or both for the
            first reached.
        seed: Of candidates and scenes; below 2^32.
        settings: Of the method.
        options: Task options that differ from the named task's, for studies.
        split: Stream of scenes to learn from; anything but ``test``.
        workers: Processes that play, or others elsewhere. The result is the same with any of them.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Scenes an evaluation, of the split ``validation``.
        on_progress: Called as the run goes on.

    Returns:
        What the run came to.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: The policy cannot be fine-tuned, or does not fit the task.
        OptionError: No budget, or a value that makes no sense.
        OutputError: ``out`` cannot be written, or holds something else than this run.
    """
    settings = settings or WaySettings()
    budget = Budget(steps, minutes)
    begun = begin(
        policy, task, options,
        split=split, seed=seed, eval_every=eval_every, eval_episodes=eval_episodes,
    )  # fmt: skip
    spec, options, base = begun.spec, begun.options, begun.base
    identity = {**begun.identity, **dataclasses.asdict(settings)}
    training = out / "training"
    with contextlib.ExitStack() as stack:
        stack.enter_context(claimed(out, identity))
        limits = {"minutes": minutes, "steps": steps}
        write_train_config(
            out, identity, limits, PACKAGES, policy=name_of(policy), players=size(workers)
        )
        stack.enter_context(one_torch_thread())
        evaluator = stack.enter_context(contextlib.closing(Evaluator(spec, options, eval_episodes)))
        network = with_choice(base, settings.reach_m)
        assert network.choice is not None
        weight = network.choice.weight

        # What was asked and answered is all the state there is: the search is told it again.
        evolution = CMA(
            mean=np.zeros(weight.numel()),
            sigma=settings.spread,
            seed=seed,
            population_size=settings.population,
        )
        generations = _read(training / "generations.json", settings.population)
        for generation in generations:
            _tell(evolution, _asked(evolution, settings), generation["costs"])
        played = _total(generations, "env_steps")
        evaluations = read_evaluations(training / "evaluations.json", played)
        curves = stack.enter_context(
            contextlib.closing(Curves(training / "tensorboard", played + 1))
        )

        def report(part: float | None = None, n: int = 0, further_s: float = 0.0) -> None:
            if on_progress is None:
                return
            env_steps, elapsed_s = played + n, _total(generations, "elapsed_s") + further_s
            used = budget.share(env_steps, elapsed_s)
            on_progress(
                Progress(
                    stage="training" if part is None else "evaluating",
                    share=used if part is None else part,
                    env_steps=env_steps,
                    updates=len(generations),
                    env_steps_per_s=env_steps / max(1e-9, elapsed_s),
                    seconds_left=(1.0 - used) / used * elapsed_s if used else math.nan,
                    episode_return=math.nan,
                    evaluation=evaluations[-1] if evaluations else None,
                )
            )

        def write(folder: Path) -> None:
            with torch.no_grad():
                weight.copy_(_weight(evolution.mean, weight))
            assert network.choice is not None
            write_folded(policy, network.choice, network.shape, folder, spec)

        while True:
            share = budget.share(played, _total(generations, "elapsed_s"))

            # Evaluate where the search stands, and keep the best of it.
            if is_due(evaluations, played, eval_every, is_over=share >= 1.0):
                evaluate_and_keep(
                    write, evaluator, evaluations, out, spec,
                    env_steps=played, updates=len(generations),
                    on_share=report,
                )  # fmt: skip
                figures = {f"eval/{k}": v for k, v in evaluations[-1].figures().items()}
                curves.add(figures, played)
            if share >= 1.0 or fallen(evaluations):
                break

            # Ask for candidates, and let all of them play the same scenes.
            started = time.perf_counter()
            candidates = _asked(evolution, settings)
            first = seed * SCENES_A_SEED + len(generations) * settings.scenes
            make: Make[tuple[int, float, int]] = _Plays(
                _MakePlayer(str(policy.resolve()), settings.reach_m),
                task, options, split, settings.patience_steps,
                [candidate.tolist() for candidate in candidates],
                range(first, first + settings.scenes),
            )  # fmt: skip
            costs = [0.0] * settings.population
            steps_played = 0
            if not isinstance(workers, int):
                make = carried(make)
            for index, cost, n in spread(
                make, range(settings.population), workers=workers, ahead=1
            ):
                costs[index] = cost + settings.penalty * float(np.square(candidates[index]).sum())
                steps_played += n
                report(None, steps_played, time.perf_counter() - started)

            # Learn from how they did, and remember it.
            _tell(evolution, candidates, costs)
            elapsed_s = time.perf_counter() - started
            generations.append({"costs": costs, "env_steps": steps_played, "elapsed_s": elapsed_s})
            played += steps_played
            with replacing(training / "generations.json") as temporary:
                temporary.write_text(json.dumps(generations) + "\n")
            curves.add(
                {
                    "rollout/outside": float(np.mean(costs)),
                    "rollout/outside of the best": min(costs),
                    "train/spread": float(np.std(candidates, axis=0).mean()),
                },
                played,
            )
        draw_rl_run(training, evaluations)
        outcome = Outcome(
            step=len(generations),
            env_steps=played,
            updates_per_env_step=len(generations) / max(1, played),
            episodes=len(generations) * settings.population * settings.scenes,
            train_s=_total(generations, "elapsed_s"),
            env_steps_per_s=played / max(1e-9, _total(generations, "elapsed_s")),
            n_parameters=weight.numel(),
            evaluation=evaluations[-1] if evaluations else None,
            has_fallen=fallen(evaluations),
        )
        with replacing(training / "outcome.json") as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(outcome), indent=2) + "\n")
        return outcome


def _asked(evolution: CMA, settings: WaySettings) -> list[npt.NDArray[np.float64]]:
    """Candidates of the next generation, each (n,)."""
    return [evolution.ask() for _ in range(settings.population)]


def _tell(
    evolution: CMA, candidates: Sequence[npt.NDArray[np.float64]], costs: Sequence[float]
) -> None:
    """Learn what candidates cost."""
    evolution.tell(list(zip(candidates, costs, strict=True)))


def _weight(candidate: npt.NDArray[np.float64], like: torch.Tensor) -> torch.Tensor:
    """A candidate (n,) as a choice has it."""
    return torch.from_numpy(candidate).to(like).view_as(like)


def _total(generations: Sequence[Mapping[str, Any]], name: str) -> Any:
    return sum(generation[name] for generation in generations)


def _read(path: Path, population: int) -> list[dict[str, Any]]:
    """Generations of an interrupted run; none if there is no file, or it is damaged."""
    try:
        generations = json.loads(path.read_bytes())
        whole = all(
            len(each["costs"]) == population
            and all(math.isfinite(number) for number in each["costs"])
            and math.isfinite(each["elapsed_s"])
            and isinstance(each["env_steps"], int)
            for each in generations
        )
    except (OSError, ValueError, TypeError, KeyError):
        return []
    return generations if whole else []


class _Player:
    """Plays a network whose choice changes from candidate to candidate."""

    def __init__(self, network: BeliefNetwork, config: Mapping[str, Any]) -> None:
        self._network, self._config = network, config
        self._compiled = CompiledBelief(network, is_frozen=False)
        self._memory: torch.Tensor | None = None

    def choose(self, candidate: Sequence[float]) -> None:
        """Choose as a candidate says from now on."""
        assert self._network.choice is not None
        weight = self._network.choice.weight
        with torch.no_grad():
            weight.copy_(_weight(np.array(candidate), weight))

    def reset(self) -> None:
        """Forget the last episode."""
        self._memory = None

    def select_action(self, observation: Any) -> npt.NDArray[np.float32]:
        """Decide."""
        inputs = network_inputs(self._network, self._config, observation)
        with torch.inference_mode():
            action, self._memory = self._compiled(
                inputs.images, inputs.state, self._memory, inputs.goal, inputs.felt
            )
        return action[0].numpy()


@dataclasses.dataclass(frozen=True)
class _MakePlayer:
    """Makes a player; travels to another machine with the folder's files.

    Attributes:
        folder: The base.
        beyond_m: See `Choice`.
    """

    folder: str
    beyond_m: float

    def __call__(self) -> _Player:
        """Make it."""
        folder = Path(self.folder)
        return _Player(with_choice(load_base(folder), self.beyond_m), read_config(folder))


@dataclasses.dataclass(frozen=True)
class _Plays:
    """Makes a worker that plays candidates, for :func:`hvs_suite.executor.spread`.

    A call takes the index of a candidate, and returns it, the mean number of control steps outside
    the tolerances in a scene, and all control steps played.

    Attributes:
        make_player: Makes what plays them.
        task: Named task.
        options: Task options that differ from it.
        split: Stream of scenes.
        patience_steps: See `WaySettings`.
        candidates: Weights of each.
        scenes: That each plays.
    """

    make_player: Callable[[], _Player]
    task: str
    options: Mapping[str, Any]
    split: str
    patience_steps: int
    candidates: Sequence[Sequence[float]]
    scenes: Sequence[int]

    @contextlib.contextmanager
    def __call__(self, note: Note) -> Iterator[Callable[[int], tuple[int, float, int]]]:
        """Make it."""
        with contextlib.closing(load(self.task, split=self.split, **self.options)) as env:
            player = self.make_player()

            def call(index: int) -> tuple[int, float, int]:
                player.choose(self.candidates[index])
                with one_torch_thread():
                    played = [
                        _outside(env, player, scene, self.patience_steps) for scene in self.scenes
                    ]
                outside, steps = zip(*played, strict=True)
                return index, float(np.mean(outside)), sum(steps)

            yield call


def _outside(
    env: "Environment", player: _Player, scene: int, patience_steps: int
) -> tuple[int, int]:
    """Play a scene until the tip has arrived, or to its end where goals follow each other.

    Returns:
        Control steps outside the tolerances, or, if the tip does not arrive or touches something,
        as many as it may take; and those that were played.
    """
    spec = env.spec
    has_one_goal = not spec.counts_goals
    settled, most = math.inf, spec.time_limit_steps
    if has_one_goal:
        settled, most = min(SETTLED_STEPS, spec.hold_steps), min(most, patience_steps)
    step = env.reset(scenario=scene)
    player.reset()
    outside = 0
    while not step.last() and env.control_steps < most and env.info["n_inside"] < settled:
        step = env.step(player.select_action(step.observation))
        outside += not env.info["n_inside"]
    info = env.info
    is_lost = info["collision"] or (has_one_goal and info["n_inside"] < settled)
    return most if is_lost else outside, env.control_steps
