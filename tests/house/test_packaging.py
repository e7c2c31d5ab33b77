"""The built wheel, the lock and the licence: what a user gets who never sees this checkout."""

import ast
import configparser
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("tasks", "datasets", "policies", "eval")


@pytest.fixture(scope="module")
def wheel_folder(tmp_path_factory):
    """The built wheel, unpacked."""
    work = tmp_path_factory.mktemp("wheel")
    source = work / "source"
    shutil.copytree(
        ROOT,
        source,
        symlinks=True,
        ignore=shutil.ignore_patterns(
            ".git", ".venv", "*.egg-info", "runs", "build", "dist", "tests", ".*_cache",
            "__pycache__",
        ),
    )  # fmt: skip
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", work, source],
        check=True,
        capture_output=True,
    )
    [wheel] = work.glob("*.whl")
    unpacked = work / "unpacked"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    return unpacked


def declared_requirements():
    """What setup.cfg asks for: the base, to learn, to play on Ray and to develop."""
    from packaging.requirements import Requirement

    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    texts = [config["options"]["install_requires"]]
    texts += [config["options.extras_require"][extra] for extra in ("learn", "ray", "dev")]
    return [
        Requirement(line)
        for text in texts
        for line in text.splitlines()
        if line.strip() and not line.startswith("#")
    ]


def tracked_files(*patterns):
    listed = subprocess.run(
        ["git", "ls-files", "-z", *patterns], cwd=ROOT, check=True, capture_output=True, text=True
    )
    return [ROOT / name for name in listed.stdout.split("\0") if name]


@pytest.mark.parametrize("room", ROOMS)
def test_wheel_holds_each_room_as_a_real_folder_with_every_module(wheel_folder, room):
    packed = wheel_folder / "hvs_suite" / room
    assert packed.is_dir()
    assert not packed.is_symlink()
    expected = {p.relative_to(ROOT / room) for p in (ROOT / room).rglob("*.py")}
    assert expected
    assert {p.relative_to(packed) for p in packed.rglob("*.py")} == expected


@pytest.mark.parametrize("room", ROOMS)
def test_wheel_holds_the_data_files_of_each_room(wheel_folder, room):
    expected = {
        p.relative_to(ROOT / room)
        for suffix in ("css", "js", "json", "md", "safetensors")
        for p in (ROOT / room).rglob(f"*.{suffix}")
    }
    packed = wheel_folder / "hvs_suite" / room
    assert {path for path in expected if not (packed / path).is_file()} == set()


def test_wheel_is_typed_and_licensed_and_brings_no_other_top_level_package(wheel_folder):
    assert (wheel_folder / "hvs_suite" / "py.typed").is_file()
    tops = {p.name for p in wheel_folder.iterdir()}
    [metadata] = [name for name in tops if name.endswith(".dist-info")]
    assert tops == {"hvs_suite", metadata}
    assert list((wheel_folder / metadata).rglob("LICENSE"))


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_have_no_init_so_that_they_shadow_nothing(room):
    assert not (ROOT / room / "__init__.py").exists()
    link = ROOT / "hvs_suite" / room
    assert link.is_symlink()
    assert link.readlink() == Path("..", room)


def test_imports_point_one_way(wheel_folder, tmp_path):
    # The linter walks packages only, so the unpacked rooms get the __init__.py they do without.
    package = tmp_path / "hvs_suite"
    shutil.copytree(wheel_folder / "hvs_suite", package)
    for folder in {module.parent for module in package.rglob("*.py")}:
        (folder / "__init__.py").touch()
    shutil.copy(ROOT / "setup.cfg", tmp_path / "setup.cfg")
    lint = (
        "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    )
    done = subprocess.run(
        [sys.executable, "-c", lint],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 broken" in done.stdout


def test_lock_names_no_host_no_hash_and_no_path():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    pinned = re.compile(r"[a-z0-9][a-z0-9.-]*==[0-9][0-9A-Za-z.+]*( ; [a-z_A-Z0-9 .'=!<>()]+)?")
    assert [line for line in lines if not pinned.fullmatch(line)] == []


def test_lock_holds_every_declared_requirement_within_its_bounds():
    pins = {}
    for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines():
        name, version = line.split(" ;")[0].split("==")
        pins[name] = version
    declared = declared_requirements()
    assert [r.name for r in declared if not r.specifier.contains(pins.get(r.name, ""))] == []


def test_every_package_that_is_imported_is_declared():
    from importlib.metadata import packages_distributions

    imported = set()
    sources = [path for top in ("hvs_suite", *ROOMS) for path in (ROOT / top).rglob("*.py")]
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add(node.module.partition(".")[0])
    foreign = imported - set(sys.stdlib_module_names) - {"hvs_suite"}
    declared = {requirement.name for requirement in declared_requirements()}
    # These install below their own prefix, so their metadata does not list their modules.
    packages = packages_distributions() | {"coal": ["coal"], "pinocchio": ["pin"]}
    assert [
        module
        for module in sorted(foreign)
        if not declared & {name.lower().replace("_", "-") for name in packages[module]}
    ] == []


def test_installed_packages_are_those_of_the_lock():
    from importlib.metadata import version

    for name in ("mujoco", "dm-control", "pin", "torch", "lerobot"):
        assert f"{name}=={version(name)}" in (ROOT / "requirements.lock").read_text()


def test_sources_name_no_registry_and_no_path_of_this_machine():
    registry = re.compile(r"(index-url|find-links)[ =]+[a-z]+://|://[^ ]*/simple\b")
    here = {ROOT, ROOT.parent, Path.home(), Path(sys.base_prefix).parent, Path(sys.prefix)}
    # The top, a system's own folder or the one for temporary files is found in honest sources too.
    common = {Path("/"), Path("/usr"), Path(tempfile.gettempdir())}
    paths = [str(path) + "/" for path in here - common]
    suspects = [
        str(path.relative_to(ROOT))
        for path in tracked_files("*.py", "*.cfg", "*.toml", "*.md", "*.lock", "*.json", "Makefile")
        if path.is_file()
        for text in [path.read_text("utf-8")]
        if registry.search(text) or any(foreign in text for foreign in paths)
    ]
    assert suspects == []
