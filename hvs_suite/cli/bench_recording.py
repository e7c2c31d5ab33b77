"""What ``hvs bench --recording`` measures: recording against bare simulation, in the same run."""

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hvs_suite.cli import console
from hvs_suite.cli.bench_simulation import two_worker_rate

WORKERS = 2

LABELS = {
    "recorded_episodes": "episodes recorded with two workers, both cameras, lossless",
    "recording_frames_per_s": "frames recorded a second, expert and resets included",
    "simulation_steps_per_s": "steps/s of two worker processes that only simulate and draw",
    "recording_ratio": "ratio of the two",
}


def recording_figures(
    task: str, options: Mapping[str, Any], episodes: int, seconds: float
) -> dict[str, float]:
    """Records a dataset that is thrown away, between two measurements of bare simulation.

    Args:
        task: A named task.
        options: Options of it.
        episodes: Episodes to record.
        seconds: How long to simulate, before and after together (s).

    Returns:
        Figures by the names of ``LABELS``. As with bare simulation, the time in which workers start
        and end does not count: it is taken from the first episode saved to the last one, with
        which, where ``episodes`` are whole blocks, all is published.
    """
    from hvs_suite.datasets.recorder import Progress, record

    before = two_worker_rate(task, options, seconds / 2)
    told: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory(prefix="hvs-bench-") as folder, console.meter() as update:

        def progress(state: Progress) -> None:
            told.append((time.perf_counter(), state.frames))
            update("recording", state.episodes / state.total, f"{state.episodes_per_s:.1f}/s")

        out = Path(folder) / "bench"
        record(task, episodes, "train", out, options, workers=WORKERS, progress=progress)
    after = two_worker_rate(task, options, seconds / 2)
    (started, first), (ended, last) = told[0], told[-1]
    rate = (last - first) / (ended - started)
    simulated = float(np.mean([before, after]))
    return {
        "recorded_episodes": episodes,
        "recording_frames_per_s": rate,
        "simulation_steps_per_s": simulated,
        "recording_ratio": rate / simulated,
    }
