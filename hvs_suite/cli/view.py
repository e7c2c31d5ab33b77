"""``hvs view``: watch one episode, in MuJoCo's viewer or as a film."""

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hvs_suite.cli.console import console
from hvs_suite.errors import RenderError

if TYPE_CHECKING:
    from hvs_suite.rollout import Episode, Policy
    from hvs_suite.tasks.shared.environment import Environment


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Watch one episode: in a window where there is a display, or as a film.

    Attributes:
        task: A named task, such as align-easy.
        scenario: Index of the scenario in the split.
        split: Name of the split the scenario comes from.
        policy: expert, servo, push, zero, random, pretrained, finetuned, a checkpoint folder or Hub
            id, or module:factory, which imports and runs that code.
        out: Write a film (.mp4 or .gif) instead of opening a window.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    scenario: int = 0
    split: str = "train"
    policy: str = "expert"
    out: Path | None = None
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Play the episode and say how it ended."""
        import hvs_suite
        from hvs_suite import pictures, registry
        from hvs_suite.files import check_writable
        from hvs_suite.policies.catalogue import policy_factory

        if self.out is None and not has_display():
            raise RenderError("there is no display here; write a film with --out FILE.mp4")
        if self.out is not None:
            pictures.check_film_suffix(self.out)
            check_writable(self.out)
        options = registry.find(self.task).options_from_text(self.option)
        make = policy_factory(self.policy, self.task, options)
        with hvs_suite.load(self.task, split=self.split, **options) as env:
            policy = make(env)
            if self.out is None:
                episode = play_in_window(env, policy, self.scenario)
            else:
                episode, frames = pictures.film_episode(env, policy, self.scenario)
                pictures.write_film(self.out, frames, 1.0 / env.spec.control_period_s)
                console().print(f"wrote {self.out} ({len(frames)} frames)")
            console().print(describe(episode, self.policy))


def has_display() -> bool:
    """Whether a window could be opened."""
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def describe(episode: "Episode", policy: str) -> str:
    """One line on how an episode ended."""
    if episode.success:
        how = f"success after {episode.steps} steps"
    elif episode.collision:
        how = f"collision in step {episode.steps}"
    else:
        how = f"time is up after {episode.steps} steps"
    errors = ", ".join(f"{name} {value:.2f}" for name, value in episode.errors.items())
    return f"{policy}, scenario {episode.scenario}: {how}; {errors}"


def play_in_window(env: "Environment", policy: "Policy", scenario: int) -> "Episode":
    """Play an episode in MuJoCo's viewer, in real time, and wait for the window to close.

    Args:
        env: Left at the last step.
        policy: Chooses the actions.
        scenario: Index in the environment's split.

    Returns:
        The episode.
    """
    import mujoco.viewer

    from hvs_suite.rollout import run_episode

    # The viewer's own contexts need no MUJOCO_GL; it must see a reset, compiled model.
    env.reset(scenario=scenario)
    physics = env.physics
    with mujoco.viewer.launch_passive(physics.model.ptr, physics.data.ptr) as viewer:
        due = time.monotonic()

        def keep_time(*_: object) -> None:
            nonlocal due
            viewer.sync()
            due += env.spec.control_period_s
            time.sleep(max(0.0, due - time.monotonic()))

        episode = run_episode(env, policy, scenario, on_step=keep_time)
        while viewer.is_running():
            time.sleep(0.05)
    return episode
