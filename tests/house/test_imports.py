"""Asking for help costs nothing: the front door and ``hvs --help`` import no heavy package."""

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
