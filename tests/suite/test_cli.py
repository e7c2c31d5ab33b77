"""The ``hvs`` command as a person or a script meets it: output, exit codes, one-line errors."""

import dataclasses
import importlib
import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import docstring_parser
import pytest

import hvs_suite
from hvs_suite.cli.main import COMMANDS, run

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
TASKS = tuple(hvs_suite.TASKS)


def refusal(capsys, *words):
    """Run a command that must be refused; the one line it says."""
    assert run(words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert err.startswith("hvs: ")
    return err


def described(command):
    """What a command's documentation says of itself and of each of its options."""
    module, _, name = COMMANDS[command].partition(":")
    kind = getattr(importlib.import_module(module), name)
    # What commands have in common is a class that they derive from, and said there.
    said = [docstring_parser.parse(each.__doc__) for each in kind.__mro__ if each is not object]
    params = [param for each in reversed(said) for param in each.params]
    return said[0].short_description, {each.arg_name: each.description for each in params}


def test_help_gives_every_command_a_line_of_its_own(capsys):
    assert run(["--help"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    words = [line.split(maxsplit=1) for line in lines]
    assert words == [[command, described(command)[0]] for command in COMMANDS]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_each_of_its_options(command, capsys):
    assert run([command, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"usage: hvs {command}" in text
    summary, options = described(command)
    assert summary in text
    module, _, name = COMMANDS[command].partition(":")
    fields = dataclasses.fields(getattr(importlib.import_module(module), name))
    assert [field.name for field in fields] == list(options)
    for option, explanation in options.items():
        before, found, _ = text.partition(" ".join(explanation.split()))
        assert found, option
        # What has no name is told by its place: a word without one, or a command of its own.
        flag = f"--{option.replace('_', '-')}"
        assert (flag in before.split()[-2:]) == (f"{flag} " in text)


def test_hvs_is_installed_as_a_command():
    done = subprocess.run(
        [sys.executable, "-c", "from hvs_suite.cli.main import main; main()", "tasks"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "align-thesis-v1" in done.stdout


def test_python_dash_m_is_the_command_and_tells_the_version():
    words = [sys.executable, "-m", "hvs_suite", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout == f"hvs {version('hvs-suite')}\n"


def test_a_shell_completes_commands_and_options_once_it_was_installed(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert run(["completion", "bash", "--install"]) == 0
    script = tmp_path / "bash-completion/completions/hvs"
    # What bash does at a press of the tabulator: look up the function, and call it on the words.
    press = """
        source "$1"; shift
        COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
        $(complete -p hvs | sed "s/.*-F \\([^ ]*\\) .*/\\1/")
        echo "${COMPREPLY[@]}"
    """
    for words, wanted in (
        ("hvs eval", "evaluate"),
        ("hvs evaluate --pol", "--policy"),
        ("hvs study abl", "ablation"),
    ):
        done = subprocess.run(
            ["bash", "-c", press, "bash", script, *words.split()], capture_output=True, text=True
        )
        assert done.stdout.split() == [wanted], done.stderr


@pytest.mark.parametrize("shell", ["bash", "fish", "zsh"])
def test_the_script_of_each_shell_names_every_command(shell, capsys):
    assert run(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert [command for command in COMMANDS if command not in script] == []


@pytest.mark.parametrize(
    ("words", "stream", "codes"),
    [
        ("tasks", "stdout", (0, 0, 2)),
        ("tasks --help", "stdout", (0, 0, 2)),
        ("tasks", "stderr", (0, 0, 0)),
        ("dance", "stderr", (2, 2, 2)),
    ],
)
def test_a_stream_that_is_closed_unread_or_full_makes_no_noise(words, stream, codes):
    command = [sys.executable, "-c", "from hvs_suite.cli.main import main; main()", *words.split()]
    other = "stderr" if stream == "stdout" else "stdout"
    normal = subprocess.run(command, capture_output=True)
    number = {"stdout": 1, "stderr": 2}[stream]
    closed = ["sh", "-c", f'exec "$@" {number}>&-', "sh", *command]
    reader, unread = os.pipe()
    os.close(reader)
    with open("/dev/full", "wb") as full, os.fdopen(unread, "wb") as pipe:
        ways = [(closed, None), (command, pipe), (command, full)]
        for (way, to), code in zip(ways, codes, strict=True):
            done = subprocess.run(way, **{stream: to, other: subprocess.PIPE})
            said = getattr(done, other)
            if to is full and stream == "stdout":
                assert said.count(b"\n") == 1
                assert said.startswith(b"hvs: standard output cannot be written")
            else:
                assert said == getattr(normal, other)
            assert done.returncode == code


def test_tasks_prints_json_that_a_script_can_read(capsys):
    assert run(["tasks", "--json"]) == 0
    tasks = json.loads(capsys.readouterr().out)
    assert tuple(task["name"] for task in tasks) == TASKS
    assert {"version", "instruction", "time_limit_steps", "tilt_tolerance_deg"} <= set(tasks[0])


def test_tasks_prints_a_row_for_each_task(capsys):
    assert run(["tasks"]) == 0
    text = capsys.readouterr().out
    assert [name for name in TASKS if f"{name}-v" not in text] == []


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["dance"], "dance"),
        ([], "hvs"),
        (["tasks", "--jsn"], "did you mean --json?"),
        (["evaluate", "--polic", "zero"], "did you mean --policy?"),
        (["evaluate", "--policy", "zero", "--out", "r", "--episode", "3"], "mean --episodes?"),
        (["verify", str(SAMPLE)], f"'hvs check {SAMPLE}'"),
        (["bench"], "--task"),
        (["bench", "--task", "align-thesis", "--seconds", "long"], "--seconds"),
    ],
)
def test_words_that_make_no_sense_are_refused_in_one_line(words, reason, capsys):
    assert reason in refusal(capsys, *words)


EVALUATE = "evaluate --task align-fixed --episodes 1 --out {folder}/r.json"


@pytest.mark.parametrize(
    "words",
    [
        f"{EVALUATE} --policy {'x' * 5000}",
        f"{EVALUATE} --policy me --server ws://localhost:99999",
        "serve --policy zero --host \u202e",
        f"serve --policy zero --host {'x' * 300}",
    ],
)
def test_what_the_system_cannot_even_look_for_is_refused_in_one_line(words, tmp_path, capsys):
    refusal(capsys, *words.format(folder=tmp_path).split())


@pytest.mark.parametrize(
    "words",
    [
        ["show", "align-thesys", "--out", "{folder}/picture.png"],
        ["view", "align-thesys", "--out", "{folder}/film.gif"],
        ["bench", "--task", "align-thesys"],
        ["certify", "align-thesys"],
        ["record", "--task", "align-thesys", "--episodes", "1", "--out", "{folder}/data"],
        ["evaluate", "--policy", "zero", "--task", "align-thesys", "--out", "{folder}/r.json"],
    ],
)
def test_unknown_task_is_refused_with_the_nearest_name(words, tmp_path, capsys):
    assert "align-thesis" in refusal(capsys, *(w.format(folder=tmp_path) for w in words))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        "show align-thesis --out {}/picture.png",
        "view align-thesis --out {}/film.gif",
        "bench --task align-thesis",
        "bench --task align-thesis --expert",
        "certify align-thesis",
        "record --task align-thesis --episodes 1 --out {}/data",
        "evaluate --policy zero --task align-thesis --out {}/r.json",
        "finetune --policy pretrained --task align-thesis --out {}/p",
        "train-sac --task align-thesis --out {}/p",
    ],
)
def test_an_option_that_makes_no_sense_is_refused_by_whatever_plays_a_task(words, tmp_path, capsys):
    words = words.format(tmp_path).split()
    for option, reason in (
        ("target_diametre_m=0.03", "did you mean target_diameter_m?"),
        ("marker=cross", "marker is 'cross', which is not disc, ring or fiducial"),
        ("marker", "name=value"),
    ):
        assert reason in refusal(capsys, *words, "--option", option)
    assert list(tmp_path.iterdir()) == []


def test_a_task_is_shown_filmed_and_measured_with_its_options(tmp_path, capsys):
    words = ["--option", "time_limit_steps=3", "--option", "marker=ring"]
    assert run(["show", "align-easy", "--out", str(tmp_path / "s.png"), *words]) == 0
    # The certificate is of the task as named.
    assert "certificate" not in capsys.readouterr().out
    film = ["--policy", "zero", "--out", str(tmp_path / "film.gif")]
    assert run(["view", "align-easy", *film, *words]) == 0
    assert "(4 frames)" in capsys.readouterr().out
    assert run(["bench", "--expert", "--episodes", "2", "--json", *words]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["options"] == {"time_limit_steps": 3, "marker": "ring"}
    assert figures["successes"] == 0
    rewards = ["train-sac", "--task", "align-easy", "--out", str(tmp_path / "p")]
    assert "--reward" in refusal(capsys, *rewards, "--option", "rewards=goal,time")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["show", "align-easy", "--out", "{file}/picture.png"], "choose another path"),
        (["show", "align-easy", "--out", "{folder}/picture.txt"], ".png"),
        (["show", "align-easy", "--out", "{folder}/folder.png"], "is a folder"),
        (["show", "align-easy", "--out", "{folder}/fifo.png"], "no regular file"),
        (["show", "align-easy", "--out", "{folder}/" + 255 * "a" + ".png"], "too long"),
        (["show", "align-easy", "--out", "/proc/picture.png"], "/proc"),
        (["view", "align-easy", "--out", "{folder}/folder.gif"], "is a folder"),
        (["view", "align-easy", "--out", "{folder}/f.gif", "--policy", "{file}"], "file"),
        (["view", "align-easy", "--out", "{folder}/f.gif", "--policy", "{full}"], "config.json"),
        (["tasks", "{folder}"], "Unrecognized"),
        (["view", "align-easy", "--out", "{folder}/film.mov"], ".mp4"),
        (["view", "align-easy", "--out", "{file}/film.gif"], "choose another path"),
        (["view", "align-easy", "--out", "{folder}/f.gif", "--scenario", "-1"], "-1"),
        (["view", "align-easy", "--out", "{folder}/f.gif", "--split", "test",
          "--scenario", "1000"], "1000"),
        (["view", "align-easy", "--out", "{folder}/f.gif", "--policy", "nobody"], "nobody"),
        (["bench", "--task", "align-easy", "--seconds", "0"], "--seconds"),
        (["record", "--task", "align-easy", "--episodes", "0", "--out", "{folder}/d"], "episodes"),
        (["record", "--task", "align-easy", "--episodes", "1", "--out", "{full}"], "--resume"),
        (["pretrain", "--data", "{folder}/none", "--out", "{folder}/p"], "none"),
        (["certify", "align-easy", "--workers", "0"], "--workers"),
        (["demo", "--out", "{full}"], "--overwrite"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line_that_says_why(words, reason, tmp_path, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.gif").mkdir()
    os.mkfifo(tmp_path / "fifo.png")
    places = {"folder": tmp_path, "file": tmp_path / "file", "full": tmp_path / "full"}
    assert reason in refusal(capsys, *(word.format(**places) for word in words))


@pytest.mark.parametrize(
    "words",
    [
        "show align-easy --out {}/picture.png",
        "view align-easy --out {}/film.gif",
        "record --task align-easy --episodes 1 --out {}/data",
        "evaluate --policy zero --task align-easy --episodes 1 --out {}/result.json",
        "pretrain --data {data} --steps 1 --out {}/policy",
        "leaderboard --draft --results {results} --out {}",
        "demo --out {}/demo",
    ],
    ids=lambda words: words.split()[0],
)
def test_a_folder_that_cannot_be_written_is_refused_in_one_line(words, tmp_path, capsys):
    # A file where a folder has to be stops root as well, which modes would not.
    blocked = tmp_path / "file"
    blocked.touch()
    places = {"data": tmp_path / "data", "results": tmp_path / "results"}
    if "{data}" in words:
        from hvs_suite.datasets.recorder import record

        record("align-easy", 1, "train", places["data"], {"time_limit_steps": 2})
    if "{results}" in words:
        out = places["results"] / "zero" / "align-easy.json"
        evaluate = "evaluate --policy zero --task align-easy --episodes 1 --out"
        assert run([*evaluate.split(), str(out)]) == 0
        capsys.readouterr()
    assert str(blocked) in refusal(capsys, *words.format(blocked, **places).split())
    assert blocked.read_bytes() == b""


@pytest.mark.parametrize(
    "words",
    [
        "show align-easy --out {}/picture.png",
        "view align-easy --out {}/film.gif",
        "bench --task align-easy --seconds 0.1",
        "record --task align-easy --episodes 1 --out {}/data",
        "evaluate --policy zero --task align-easy --episodes 1 --out {}/result.json",
    ],
    ids=lambda words: words.split()[0],
)
def test_without_an_opengl_library_the_one_line_names_the_package(
    words, tmp_path, capsys, monkeypatch
):
    # Set first, so that the old value comes back although the choice of a backend writes it.
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda _name: None)
    line = refusal(capsys, *words.format(tmp_path).split())
    assert "apt-get install libegl1" in line
    assert "hvs doctor" in line
    assert not list(tmp_path.glob("*.*"))


def test_view_without_a_display_asks_for_a_file(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert "--out" in refusal(capsys, "view", "align-easy")


def test_show_writes_a_picture_and_prints_the_certificate(tmp_path, capsys):
    from PIL import Image

    out = tmp_path / "pictures" / "easy.png"
    assert run(["show", "align-easy", "--out", str(out)]) == 0
    assert "certificate" in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.format == "PNG"
        assert min(picture.size) > 800
    assert [p.name for p in out.parent.iterdir()] == ["easy.png"]


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_view_films_every_control_step(suffix, tmp_path):
    import imageio.v3 as iio

    out = tmp_path / f"film.{suffix}"
    assert run(["view", "align-easy", "--policy", "zero", "--out", str(out)]) == 0
    frames = iio.imread(out, plugin="pyav" if suffix == "mp4" else "pillow")
    assert len(frames) == 1 + 20
    assert frames[0].std() > 10


def test_bench_prints_every_figure_as_json(capsys):
    assert run(["bench", "--task", "align-easy", "--seconds", "0.3", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["task"] == "align-easy"
    assert figures["options"] == {}
    assert min(v for name, v in figures.items() if name not in ("task", "options")) > 0
    assert {
        "steps_per_s",
        "bare_steps_per_s",
        "ratio",
        "reset_ms",
        "steps_per_s_no_cameras",
        "two_worker_steps_per_s",
        "two_worker_speedup",
    } <= set(figures)


def test_bench_compares_with_a_loop_that_ends_in_the_same_pictures():
    import numpy as np

    import hvs_suite
    from hvs_suite.cli.bench_simulation import BareLoop, run_once

    with hvs_suite.load("align-thesis") as env:
        episode = run_once(env, 3)
        bare = BareLoop(env)
        bare.restore(episode.start)
        for control in episode.controls:
            pictures = bare.step(control)
        bare.close()
    for name, picture in zip(("eih", "eth"), pictures, strict=True):
        difference = np.abs(picture.astype(int) - episode.observation[name])
        assert difference.mean() < 0.1


def test_doctor_names_the_backend_in_use(capsys):
    assert run(["doctor", "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert findings["renders"] is True
    assert findings["renderers"][findings["backend_in_use"]]["works"] is True
    assert findings["versions"]["mujoco"].startswith("3.")


def test_doctor_names_the_package_that_a_missing_library_needs(monkeypatch):
    from hvs_suite.cli import doctor

    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda _name: None)
    for backend, package in (("egl", "libegl1"), ("osmesa", "libosmesa6"), ("glfw", "libgl1")):
        probe = doctor.probe_renderer(backend)
        assert not probe.works
        assert f"apt-get install {package}" in probe.remedy


def test_interrupting_a_command_ends_it_with_130(monkeypatch, capsys):
    from hvs_suite.cli.tasks import Tasks

    def interrupt(_self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Tasks, "run", interrupt)
    assert run(["tasks"]) == 130
    assert capsys.readouterr().err == "hvs: interrupted\n"


def test_defects_of_ours_keep_their_traceback(monkeypatch):
    from hvs_suite.cli.tasks import Tasks

    def fail(_self):
        raise ZeroDivisionError

    monkeypatch.setattr(Tasks, "run", fail)
    with pytest.raises(ZeroDivisionError):
        run(["tasks"])


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    from hvs_suite.files import replacing

    path = tmp_path / "result.json"
    path.write_text("old")

    def interrupted_write():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_has_one_writer_until_that_ends_however_it_ends(tmp_path):
    from hvs_suite.errors import OutputError
    from hvs_suite.policies.training.run_folder import claimed

    holds = (
        "import pathlib, sys; from hvs_suite.files import only_writer\n"
        "with only_writer(pathlib.Path(sys.argv[1])): print('mine', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", holds, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"mine\n"
        with (
            pytest.raises(OutputError, match="another process is writing into"),
            claimed(tmp_path, {}),
        ):
            pytest.fail("two have it")
        writer.kill()
    with claimed(tmp_path, {}):
        pass


@pytest.mark.parametrize(
    ("plumbing", "code"),
    [
        ("| true", 0),
        (">&-", 0),
        ("2>&-", 0),
        (">&- 2>&-", 0),
        ("2>&1 | true", 0),
        (">/dev/full", 2),
    ],
)
def test_an_evaluation_outlives_whoever_reads_along(plumbing, code, tmp_path):
    hvs = f"{sys.executable} -c 'from hvs_suite.cli.main import main; main()'"
    words = "evaluate --policy zero --episodes 1 --task align-fixed --task align-easy --out results"
    script = f"set -o pipefail; {hvs} {words} {plumbing}"
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr
    written = {path.name for path in tmp_path.glob("results/*.json")}
    assert written == {"align-fixed.json", "align-easy.json"}
