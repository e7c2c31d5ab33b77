"""``hvs bench --expert``, ``--recording`` and ``--ray``: figures that hold together."""

import json
import subprocess
import sys

import numpy as np
import pytest

import hvs_suite
from hvs_suite.cli.bench_expert import LABELS, least_times
from hvs_suite.cli.main import run
from hvs_suite.tasks.shared.start import steps_lower_bound


def test_expert_figures_meet_the_bound(capsys):
    assert run(["bench", "--expert", "--episodes", "15", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures) == {"task", "options", *LABELS}
    assert figures["task"] == "align-thesis"
    assert (figures["successes"], figures["collisions"]) == (15, 0)
    assert figures["speed_bound_s"] < figures["bound_s"] < 0.1 * figures["mean_steps"]
    assert figures["mean_steps"] <= 1.15 * (figures["bound_steps"] + 1)
    expected = figures["mean_steps"] / (figures["bound_steps"] + 1)
    assert figures["ratio"] == pytest.approx(expected, abs=2e-3)
    assert figures["speed_ratio"] > figures["ratio"]
    assert 0 < figures["decision_us_p50"] <= figures["decision_us_p99"]


def test_bound_is_the_scenarios_own():
    with hvs_suite.load("align-drill", split="test", observations="state") as env:
        for scenario in range(3):
            env.reset(scenario=scenario)
            start, goal = env.scenario.start, env.goal()
            limited, quick, steps, quick_steps = least_times(
                env.spec, start, goal.position, goal.normal
            )
            assert steps == steps_lower_bound(env.spec, start, goal)
            assert quick < limited
            further = env.spec.hold_steps - 1 + env.spec.latency_steps
            assert quick_steps == np.ceil(quick / 0.1) + further


@pytest.mark.timeout(300)
def test_recording_is_compared_with_bare_simulation(capsys):
    words = ["bench", "--task", "align-fixed", "--recording", "--episodes", "6", "--seconds", "1"]
    assert run([*words, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    rate, simulated = figures["recording_frames_per_s"], figures["simulation_steps_per_s"]
    assert figures["recording_ratio"] == pytest.approx(rate / simulated, abs=2e-3)


@pytest.mark.parametrize("episodes", ["1", "1001"])
def test_counts_that_say_nothing_are_refused(episodes, capsys):
    assert run(["bench", "--expert", "--episodes", episodes]) == 2
    assert "--episodes" in capsys.readouterr().err


@pytest.mark.slow
def test_playing_on_ray_is_measured_against_local_processes():
    pytest.importorskip("ray")
    # In a process of its own: another test may have joined another cluster in this one.
    words = ["bench", "--task", "align-fixed", "--ray", "--episodes", "16", "--json"]
    done = subprocess.run(
        [sys.executable, "-c", f"from hvs_suite.cli.main import main; main({words!r})"],
        capture_output=True,
        text=True,
        check=True,
    )
    figures = json.loads(done.stdout)
    ratio = figures["ray_episodes_per_s"] / figures["local_episodes_per_s"]
    assert figures["ray_ratio"] == pytest.approx(ratio, abs=0.01)
