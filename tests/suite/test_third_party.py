"""A family of tasks in a package of somebody else's, from its installation to a checked dataset."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent / "third_party"
MODULE = PACKAGE / "hvs_shelf.py"
HVS = "from hvs_suite.cli.main import main; main()"
pytestmark = pytest.mark.timeout(300)

_DOORS = """
import gymnasium
import hvs_suite
with hvs_suite.load("shelf-high", split="test") as env:
    seen = env.reset(scenario=4).observation
    assert 0.03 <= env.goal().target[2] <= 0.06
other = gymnasium.make("hvs_suite/shelf-high-v1", split="test")
observation, info = other.reset(options={"scenario": 4})
assert (observation["eth"] == seen["eth"]).all()
print(info["task"], *info["errors"])
"""


def run(
    *words: str | Path, path: Path, cwd: Path, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run Python with a folder of packages on its path."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join([str(path), os.environ.get("PYTHONPATH", "")])}
        | variables,
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )


def hvs(
    *words: str | Path, path: Path, cwd: Path, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run the command likewise."""
    return run("-c", HVS, *words, path=path, cwd=cwd, **variables)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the package is installed into, as a wheel is."""
    work = tmp_path_factory.mktemp("third_party")
    source = work / "source"
    source.mkdir()
    for name in ("pyproject.toml", MODULE.name):
        (source / name).write_bytes((PACKAGE / name).read_bytes())
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", work, source],
        check=True,
        capture_output=True,
    )
    [wheel] = work.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(work / "site")
    return work / "site"


def test_the_family_is_small() -> None:
    assert len(MODULE.read_text("utf-8").splitlines()) <= 120


def test_its_tasks_are_listed_loaded_and_made_like_our_own(installed: Path, tmp_path: Path) -> None:
    listed = hvs("tasks", path=installed, cwd=tmp_path)
    assert "shelf-easy-v1" in listed.stdout, listed.stderr
    assert "align-thesis-v1" in listed.stdout
    done = run("-c", _DOORS, path=installed, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:2] == ["shelf-high", "position_error_mm"]


def test_its_demonstrations_are_recorded_and_checked(installed: Path, tmp_path: Path) -> None:
    words = ["--task", "shelf-easy", "--episodes", "3", "--workers", "2", "--out", "data"]
    done = hvs("record", *words, path=installed, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "3 episodes, 3 of them solved" in done.stdout
    checked = hvs("check", "data", path=installed, cwd=tmp_path)
    assert "3 episodes" in checked.stdout
    assert (checked.stdout.count("no damage"), checked.returncode) == (1, 0), checked.stdout
    # Who has not installed the package is told which task is missing.
    alone = hvs("check", "data", path=tmp_path, cwd=tmp_path)
    assert alone.returncode != 0
    assert "shelf-easy" in alone.stdout + alone.stderr
    assert "Traceback" not in alone.stderr


def test_a_module_can_be_tried_without_installing_it(tmp_path: Path) -> None:
    """Workers import it too."""
    (tmp_path / MODULE.name).write_bytes(MODULE.read_bytes())
    words = ["--task", "shelf-easy", "--episodes", "2", "--workers", "2", "--out", "data"]
    done = hvs("--plugin", "hvs_shelf", "record", *words, path=tmp_path, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 episodes, 2 of them solved" in done.stdout


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--plugin", "no_such_module", "tasks"], "cannot import the tasks of no_such_module"),
        (["--plugin=broken", "tasks"], "cannot import the tasks of broken: ZeroDivisionError"),
        (["--plugin", "shelf.py/", "tasks"], "names a module such as my_tasks"),
        (["--plugin"], "names a module such as my_tasks"),
    ],
)
def test_a_module_that_cannot_be_imported_ends_in_one_line(
    tmp_path: Path, words: list[str], reason: str
) -> None:
    (tmp_path / "broken.py").write_text("1 / 0\n")
    done = hvs(*words, path=tmp_path, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert reason in done.stderr


def test_a_broken_package_does_not_take_our_own_tasks_away(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("1 / 0\n")
    done = hvs("tasks", path=tmp_path, cwd=tmp_path, HVS_PLUGINS="broken")
    assert done.returncode == 0
    assert "align-thesis-v1" in done.stdout
    assert "its tasks are missing" in done.stderr
