"""``hvs bench``: how fast a task steps, against a bare loop over the same compiled model."""

import dataclasses

from hvs_suite.cli import console
from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure how fast a task steps on this machine.

    Environment and bare loop take turns, episode by episode, in one thread of one process, so that
    other programs on the machine slow both equally.

    Attributes:
        task: A named task, such as align-easy; align-thesis with --expert, --recording or --ray.
        seconds: How long to measure each figure (s).
        expert: Measure the expert instead: its steps against the least that the limits of joint
            speed and acceleration allow, and the time of a decision.
        recording: Measure recording instead: its rate against bare simulation.
        ray: Measure playing on Ray instead: its rate with two actors on this machine against that
            of two local processes.
        episodes: Episodes that the expert plays or that are recorded.
        json: Print the figures as JSON.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    task: str | None = None
    seconds: float = 6.0
    expert: bool = False
    recording: bool = False
    ray: bool = False
    episodes: int = 600
    json: bool = False
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Measure and print."""
        if not self.seconds > 0:
            raise OptionError(f"--seconds must be above 0, not {self.seconds:g}")
        demonstrations = self.expert or self.recording or self.ray
        if self.task is None and not demonstrations:
            raise OptionError("say what to measure: --task, such as --task align-easy")
        from hvs_suite.registry import find
        from hvs_suite.tasks.shared.option_types import listed

        task = self.task or "align-thesis"
        options = find(task).options_from_text(self.option)
        figures: dict[str, float] = {}
        labels: dict[str, str] = {}
        if demonstrations:
            self._check_episodes()
        if self.expert:
            from hvs_suite.cli import bench_expert

            figures |= bench_expert.expert_figures(task, options, self.episodes)
            labels |= bench_expert.LABELS
        if self.recording:
            from hvs_suite.cli import bench_recording

            figures |= bench_recording.recording_figures(task, options, self.episodes, self.seconds)
            labels |= bench_recording.LABELS
        if self.ray:
            from hvs_suite.cli import bench_ray

            figures |= bench_ray.ray_figures(task, options, self.episodes)
            labels |= bench_ray.LABELS
        if not demonstrations:
            from hvs_suite.cli import bench_simulation

            figures = bench_simulation.simulation_figures(task, options, self.seconds)
            labels = bench_simulation.LABELS
        if self.json:
            console.print_json(
                {"task": task, "options": options}
                | {name: round(value, 3) for name, value in figures.items()}
            )
            return
        console.print_table(
            (f"{task} with {listed(options)}" if options else task, "measured"),
            [(label, f"{figures[name]:.2f}") for name, label in labels.items()],
        )

    def _check_episodes(self) -> None:
        """Refuse counts that say nothing or go beyond the test split."""
        if not 2 <= self.episodes <= 1000:
            raise OptionError(f"--episodes is {self.episodes}; use 2 to 1000")
