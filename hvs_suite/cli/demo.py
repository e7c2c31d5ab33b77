"""``hvs demo``: the whole pipeline once, small enough to wait for."""

import dataclasses
import json
import shutil
from pathlib import Path

from hvs_suite.cli import console
from hvs_suite.errors import OptionError, OutputError

# Without disturbed episodes and starts near the goal, a policy never learns to correct itself.
NOISE_RAD = 0.02
PARTS = ("dataset", "policy", "results", "board", "episode.gif")
STEPS_A_MINUTE = 250
"""Where fewer optimiser steps are made the demo says what to do; two cores that do nothing else
make twice as many (docs/experiments/busy-machine.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo:
    """Record demonstrations, train a policy on them, score it, build a board, film an episode.

    All steps are real but small; longer training gives a better policy (see hvs pretrain).

    Attributes:
        out: Folder for everything the demo makes.
        task: Named task.
        episodes: Demonstrations to record.
        minutes: Training time (min).
        dagger_rounds: How often the policy plays in between and the expert corrects it.
        dagger_frames: Frames of each of these rounds.
        evaluations: Test scenarios to score the policy on.
        overwrite: Replace what an earlier demo left in the folder.
    """

    out: Path = Path("runs/demo")
    task: str = "align-easy"
    episodes: int = 1000
    minutes: float = 4.0
    dagger_rounds: int = 1
    dagger_frames: int = 2000
    evaluations: int = 50
    overwrite: bool = False

    def run(self) -> None:
        """Run the stages one after the other and report on them."""
        from hvs_suite.cli.evaluate import Evaluate
        from hvs_suite.cli.leaderboard import Leaderboard
        from hvs_suite.cli.pretrain import Pretrain
        from hvs_suite.cli.record import Record

        for name in ("episodes", "minutes", "evaluations"):
            if not getattr(self, name) > 0:
                raise OptionError(f"--{name} must be above 0, not {getattr(self, name)}")
        self._make_room()
        dataset, policy = self.out / "dataset", self.out / "policy"
        results, board = self.out / "results", self.out / "board"
        film = self.out / "episode.gif"
        result = results / "demo" / f"{self.task}.json"
        times_s: dict[str, float] = {}

        with console.stage(f"record {self.episodes} demonstrations of {self.task}", times_s):
            Record(
                task=self.task,
                episodes=self.episodes,
                out=dataset,
                start="mixed",
                noise=NOISE_RAD,
                workers=2,
            ).run()
        with console.stage(f"train a policy on them for {self.minutes:g} min", times_s):
            Pretrain(
                data=dataset,
                out=policy,
                minutes=self.minutes,
                dagger_rounds=self.dagger_rounds,
                dagger_frames=self.dagger_frames,
            ).run()
        with console.stage(f"score it on {self.evaluations} test scenarios", times_s):
            Evaluate(
                policy=str(policy),
                task=(self.task,),
                split="test",
                episodes=self.evaluations,
                workers=2,
                out=result,
            ).run()
        with console.stage("build the board", times_s):
            Leaderboard(results=results, out=board, ledger=board / "replays.json", draft=True).run()
        with console.stage("film an episode", times_s):
            film_one(policy, self.task, _solved_scenario(result), film)

        self._report(result, board, times_s)

    def _make_room(self) -> None:
        """Refuse a folder that is in use, or clear what an earlier demo left there."""
        if self.out.is_dir() and any(self.out.iterdir()) and not self.overwrite:
            raise OutputError(f"{self.out} is not empty; name another --out, or use --overwrite")
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            # Only what a demo makes: the folder may be anything.
            for part in PARTS:
                path = self.out / part
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot write {self.out}: {error.strerror}; choose another --out"
            ) from error

    def _report(self, result: Path, board: Path, times_s: dict[str, float]) -> None:
        """Print the policy's success as it is, where everything lies, and what it took."""
        from hvs_suite.eval.scoring import result_file

        summary = result_file.load(result).summary
        low, high = summary.pc_success_ci95
        console.print_times(times_s)
        print(
            f"{self.task}, the demo's own policy: {summary.n_success} of "
            f"{summary.n_episodes} solved, {summary.pc_success:.1f} % "
            f"(95 % interval {low:.1f} to {high:.1f} %)"
        )
        for what, path in (
            ("dataset", self.out / "dataset"),
            ("policy", self.out / "policy"),
            ("evaluation", result),
            ("board", board / "LEADERBOARD.md"),
            ("episode", self.out / "episode.gif"),
        ):
            print(f"{what:<12}{path}")
        outcome = json.loads((self.out / "policy/training/outcome.json").read_text())
        if hint := busy(outcome["step"], self.minutes):
            print(hint)


def busy(steps: int, minutes: float) -> str:
    """What to do about a training that got through little, in words; empty otherwise.

    Args:
        steps: Optimiser steps.
        minutes: How long it learned (min).
    """
    if steps >= STEPS_A_MINUTE * minutes:
        return ""
    return (
        f"The policy learned for {steps} steps only; two free cores make some "
        f"{2 * STEPS_A_MINUTE * minutes:.0f} in that time. On a busy machine set "
        "OMP_WAIT_POLICY=PASSIVE, or give it more --minutes."
    )


def _solved_scenario(result: Path) -> int:
    """The first scenario of a result that was solved, 0 if none was."""
    from hvs_suite.eval.scoring import result_file

    rows = result_file.load(result).episodes
    return next((row.scenario for row in rows if row.success), 0)


def film_one(policy: Path, task: str, scenario: int, film: Path) -> None:
    """Film a test scenario played by a checkpoint.

    Args:
        policy: Checkpoint folder.
        task: Named task.
        scenario: Index of the scenario.
        film: GIF to write.
    """
    import hvs_suite
    from hvs_suite import pictures
    from hvs_suite.cli.view import describe
    from hvs_suite.policies.catalogue import policy_factory

    with hvs_suite.load(task, split="test") as env:
        player = policy_factory(str(policy), task)(env)
        episode, frames = pictures.film_episode(env, player, scenario)
        pictures.write_film(film, frames, 0.5 / env.spec.control_period_s)
    print(describe(episode, "the demo's policy"))
