"""A family of tasks in a package of somebody else's, from its installation to a board."""

import json
import os
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent / "third_party"
MODULE = PACKAGE / "hvs_shelf.py"
PAGE = (Path(__file__).parents[2] / "docs" / "own-task.md").read_text("utf-8")
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
_NAMES = """
import sys
from pathlib import Path
from hvs_suite.errors import ResultError
from hvs_suite.eval.board import ours
from hvs_suite.eval.scoring import result_file
expert, mine = (Path(sys.argv[1], name, "shelf-easy.json") for name in ("expert", "mine"))
ours.check(expert, result_file.load(expert))
ours.check(mine, result_file.load(mine))
for path, file in ((expert, mine), (mine, expert)):
    try:
        ours.check(path, result_file.load(file))
    except ResultError:
        continue
    raise AssertionError(f"{file} passes as {path}")
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


_EVALUATE = (
    "evaluate --policy zero --task shelf-easy --episodes 2 --workers 2 "
    "--out results/zero/shelf-easy.json"
)


def plugged_in(folder: Path, *lines: str) -> None:
    """Run commands where the module lies, not installed."""
    (folder / MODULE.name).write_bytes(MODULE.read_bytes())
    for line in lines:
        done = hvs("--plugin", "hvs_shelf", *line.split(), path=folder, cwd=folder)
        assert done.returncode == 0, (line, done.stdout, done.stderr)


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


def test_the_page_shows_this_very_package() -> None:
    blocks = dict(re.findall(r"```(python|toml)\n(.*?)```", PAGE, re.DOTALL))
    assert blocks["python"] == MODULE.read_text("utf-8")
    assert blocks["toml"] == (PACKAGE / "pyproject.toml").read_text("utf-8")


@pytest.mark.timeout(900)
def test_it_goes_from_demonstrations_to_a_board_by_the_commands_of_the_page(
    installed: Path, tmp_path: Path
) -> None:
    """In miniature: few episodes and steps, and a board that says it is a draft."""
    block = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)[-1]
    for long, short in (
        ("--episodes 1000", "--episodes 3"),
        ("--minutes 10 --dagger-rounds 4", "--steps 2 --dagger-rounds 1 --dagger-frames 20"),
        ("hvs leaderboard", "hvs leaderboard --draft"),
    ):
        assert long in block
        block = block.replace(long, short)
    said = {}
    for line in block.splitlines():
        program, *words = shlex.split(line)
        assert program == "hvs"
        done = hvs(*words, path=installed, cwd=tmp_path)
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        said[words[0], words[words.index("--policy") + 1] if "--policy" in words else ""] = done
    assert "3 episodes" in said["record", ""].stdout
    assert said["check", ""].stdout.count("no damage") == 1
    assert "DAgger round 1: 20 frames" in said["pretrain", ""].stdout
    assert "3 of 3 (100.0 %)" in said["evaluate", "expert"].stdout
    assert said["verify", ""].stdout.count("as it says; 3 of 3") == 2
    board = (tmp_path / "runs" / "board" / "LEADERBOARD.md").read_text("utf-8")
    assert "## shelf-easy-v1" in board
    assert "| expert | 100" in board
    assert "| mine | " in board
    # The policy remembers what it is for.
    config = json.loads((tmp_path / "runs" / "policy" / "config.json").read_text("utf-8"))
    assert config["family"] == "shelf"
    # On a board of one's own our names may stand, but for our own policies alone.
    named = run("-c", _NAMES, "runs/results", path=installed, cwd=tmp_path)
    assert named.returncode == 0, named.stderr
    # Without the package, the message says which task is missing.
    for words in ("check runs/shelf", "verify runs/results"):
        alone = hvs(*words.split(), path=tmp_path, cwd=tmp_path)
        assert alone.returncode != 0
        assert "shelf-easy" in alone.stdout + alone.stderr
        assert "Traceback" not in alone.stderr


def test_a_module_is_scored_without_being_installed(tmp_path: Path) -> None:
    """Workers import it too."""
    plugged_in(tmp_path, _EVALUATE)
    assert (tmp_path / "results" / "zero" / "shelf-easy.json").stat().st_size > 0


@pytest.mark.slow
def test_a_module_goes_to_a_board_without_being_installed(tmp_path: Path) -> None:
    plugged_in(
        tmp_path,
        "record --task shelf-easy --episodes 2 --noise 0.02 --workers 2 --out data",
        _EVALUATE,
        "verify results --workers 2",
        "leaderboard --draft --results results --out board",
        "show shelf-easy --option height_m=0.02,0.05 --out shelf.png",
    )
    assert "## shelf-easy-v1" in (tmp_path / "board" / "LEADERBOARD.md").read_text("utf-8")
    assert (tmp_path / "shelf.png").stat().st_size > 0


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
