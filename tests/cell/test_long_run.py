"""Thousands of resets: memory stays flat, and the process exits without a word."""

import os
import subprocess
import sys

import pytest

_PROBE = """
import gc
import resource
import sys
import hvs_suite

task, resets, close = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "close"

def resident_kib():
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() // 1024

env = hvs_suite.load(task)
for i in range(resets // 5):
    env.reset(scenario=i)
before = resident_kib()
for i in range(resets // 5, resets):
    time_step = env.reset(scenario=i)
    if i % 50 == 0:
        env.step(env.commandable(env.scenario.start))
print((resident_kib() - before) // 1024)
if close:
    env.close()
"""
MAX_GROWTH_MIB = 8


def play(task: str, resets: int, end: str) -> int:
    """Reset a task often in a process of its own; growth of its memory (MiB)."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", _PROBE, task, str(resets), end],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return int(done.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("end", ["close", "leave"])
def test_a_thousand_resets_leave_memory_flat_and_the_exit_is_silent(end: str) -> None:
    """Whether the environment is closed or just left to the interpreter's exit."""
    assert play("align-thesis", 1000 if end == "leave" else 50, end) <= MAX_GROWTH_MIB


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.each_task
def test_ten_thousand_resets_leave_memory_flat_and_the_exit_is_silent(task: str) -> None:
    assert play(task, 10_000, "leave") <= MAX_GROWTH_MIB
