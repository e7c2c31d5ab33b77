"""What importing the suite does: nothing heavy, and threads that leave a busy machine its cores."""

import os
import subprocess
import sys

import pytest

HEAVY = ("torch", "mujoco", "dm_control", "lerobot", "pinocchio", "matplotlib", "datasets", "ray")


@pytest.mark.parametrize(
    "statement",
    [
        "import hvs_suite; hvs_suite.TASKS",
        "import hvs_suite.rollout, hvs_suite.statistics",
        "from hvs_suite.cli.main import run; assert run(['--help']) == 0",
        "from hvs_suite.cli.main import run; assert run(['evaluate', '--help']) == 0",
        "from hvs_suite.cli.main import run; assert run(['tasks', '--json']) == 0",
    ],
)
def test_nothing_heavy_is_imported_by(statement):
    probe = f"{statement}\nimport sys; print(*[m for m in {HEAVY!r} if m in sys.modules], sep=',')"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == ""


@pytest.mark.parametrize(
    ("chosen", "spins"),
    [
        ({}, "20000"),
        ({"GOMP_SPINCOUNT": "7"}, "7"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "None"),
    ],
)
def test_threads_spin_for_a_while_unless_the_user_says_otherwise(chosen, spins):
    environment = {
        k: v for k, v in os.environ.items() if k not in {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"}
    }
    probe = "import hvs_suite, os; print(os.environ.get('GOMP_SPINCOUNT'))"
    done = subprocess.run(
        [sys.executable, "-c", probe],
        capture_output=True,
        text=True,
        check=True,
        env=environment | chosen,
    )
    assert done.stdout.splitlines()[-1] == spins
