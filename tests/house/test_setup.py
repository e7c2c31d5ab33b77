"""``scripts/make_venv.sh``: finds a Python wherever one may be, and says so where there is none."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STARTERS = ("python3.12", "python3.13", "python3", "python")
# Stands for uv: notes what it is asked, and makes nothing but the folder.
UV = """#!/bin/sh
echo "$@" >> "$LOG"
if [ "$1" = venv ]; then mkdir -p .venv; fi
if [ "$1" = python ]; then exit 2; fi
exit 0
"""


def executable(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path):
    """A checkout on a machine whose Pythons on the PATH are shims that fail, as pyenv's do."""
    for name in ("scripts/make_venv.sh", "requirements.lock"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    executable(tmp_path / "bin" / "uv", UV)
    for name in (*STARTERS, "pyenv"):
        executable(tmp_path / "bin" / name, "#!/bin/sh\necho 'pyenv: not found' >&2\nexit 127\n")
    return tmp_path


def make_venv(machine, **more):
    env = {
        "PATH": f"{machine / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(machine / "home"),
        "LOG": str(machine / "log"),
        **more,
    }
    return subprocess.run(
        ["bash", str(machine / "scripts" / "make_venv.sh")],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )


def real_python(path):
    """This very interpreter under another name."""
    executable(path, f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    return path


def old_python(path):
    """A Python that says it is too old."""
    executable(path, "#!/bin/sh\nexit 1\n")
    return path


def used(machine):
    """The Python that the virtual environment was made with."""
    [line] = [line for line in (machine / "log").read_text().splitlines() if "venv" in line.split()]
    words = line.split()
    return words[words.index("--python") + 1]


@pytest.mark.parametrize("root", ["home/.pyenv", "elsewhere"])
def test_a_pyenv_that_is_not_on_the_path_is_found_behind_shims_that_fail(machine, root):
    old_python(machine / root / "versions" / "3.12.0" / "bin" / "python")
    python = real_python(machine / root / "versions" / "3.12.9" / "bin" / "python")
    more = {} if root.startswith("home") else {"PYENV_ROOT": str(machine / root)}
    done = make_venv(machine, **more)
    assert (done.returncode, done.stderr) == (0, "")
    assert used(machine) == str(python)
    assert f"making .venv with Python 3.{sys.version_info.minor}" in done.stdout
    assert "locked packages" in done.stdout
    assert (machine / ".venv" / ".up-to-date").exists()


def test_the_python_that_is_named_is_taken(machine):
    real_python(machine / "home" / ".pyenv" / "versions" / "3.12.9" / "bin" / "python")
    python = real_python(machine / "mine" / "python3")
    assert make_venv(machine, PYTHON=str(python)).returncode == 0
    assert used(machine) == str(python)


def test_a_python_that_is_named_and_too_old_is_refused_in_one_line(machine):
    python = old_python(machine / "mine" / "python3")
    done = make_venv(machine, PYTHON=str(python))
    assert done.returncode == 1
    assert done.stderr == f"setup: PYTHON={python} does not run, or is not Python 3.12 or 3.13.\n"
    assert not (machine / ".venv").exists()
