"""Entry point of ``hvs``: reads the command line, runs one command, turns errors into one line.

Exit codes: 0 on success, 1 where a check found something wrong, 2 for a user's mistake (one line on
stderr that says how to correct it), 130 when interrupted. Only defects of the suite show a
traceback.
"""

import contextlib
import difflib
import importlib
import inspect
import io
import logging
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import tyro

from hvs_suite.cli import streams
from hvs_suite.errors import HvsError, OptionError
from hvs_suite.names import shown

# Name -> where its dataclass lives. Those modules import nothing heavy at the top, so that
# `hvs --help` answers at once.
COMMANDS = {
    "tasks": "hvs_suite.cli.tasks:Tasks",
    "show": "hvs_suite.cli.show:Show",
    "view": "hvs_suite.cli.view:View",
    "record": "hvs_suite.cli.record:Record",
    "check": "hvs_suite.cli.check:Check",
    "attach": "hvs_suite.cli.attach:Attach",
    "replay": "hvs_suite.cli.replay:Replay",
    "share": "hvs_suite.cli.share:Share",
    "fetch": "hvs_suite.cli.fetch:Fetch",
    "pretrain": "hvs_suite.cli.pretrain:Pretrain",
    "finetune": "hvs_suite.cli.finetune:Finetune",
    "finetune-way": "hvs_suite.cli.finetune_way:FinetuneWay",
    "train-sac": "hvs_suite.cli.train_sac:TrainSac",
    "ship": "hvs_suite.cli.ship:Ship",
    "evaluate": "hvs_suite.cli.evaluate:Evaluate",
    "serve": "hvs_suite.cli.serve:Serve",
    "verify": "hvs_suite.cli.verify:Verify",
    "compare": "hvs_suite.cli.compare:Compare",
    "failures": "hvs_suite.cli.failures:Failures",
    "import-lerobot": "hvs_suite.cli.import_lerobot:ImportLerobot",
    "leaderboard": "hvs_suite.cli.leaderboard:Leaderboard",
    "bench": "hvs_suite.cli.bench:Bench",
    "study": "hvs_suite.cli.study:Study",
    "certify": "hvs_suite.cli.certify:Certify",
    "doctor": "hvs_suite.cli.doctor:Doctor",
    "completion": "hvs_suite.cli.completion:Completion",
    "demo": "hvs_suite.cli.demo:Demo",
    "reproduce": "hvs_suite.cli.reproduce:Reproduce",
}

PARSER = (tyro.conf.FlagCreatePairsOff, tyro.conf.UseAppendAction)
"""How tyro reads every command."""
USER_ERROR = 2
INTERRUPTED = 130


class Command(Protocol):
    """What every command offers."""

    def run(self) -> int | None:
        """Do it; the exit code, where it is not 0."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``hvs`` and exit.

    Args:
        arguments: Words after ``hvs``; those of the process by default.
    """
    streams.outlive_readers()
    code = run(sys.argv[1:] if arguments is None else arguments)
    if not streams.flush():
        complain("standard output cannot be written: the device is full, say")
        code = code or USER_ERROR
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code.

    Args:
        arguments: Words after ``hvs``.
    """
    _quieten_libraries()
    try:
        return parse(arguments).run() or 0
    except SystemExit as end:  # the parser has printed help or its complaint
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except HvsError as error:
        complain(str(error))
        return USER_ERROR
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED


def _quieten_libraries() -> None:
    """Keep libraries from printing over our own progress, unless the user asked them to."""
    # Ninety lines of traceback where torchcodec finds no ffmpeg; `hvs doctor` says it in one.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def complain(reason: str) -> None:
    """Print one line to stderr, whatever line breaks and escape sequences the reason holds."""
    print(f"hvs: {shown(' '.join(reason.split()))}", file=sys.stderr)


def parse(arguments: Sequence[str]) -> Command:
    """Build the command that the words ask for.

    Raises:
        OptionError: A plugin cannot be imported.
        SystemExit: After help (0), or after one line about words that make no sense (2).
    """
    arguments = _import_plugins(arguments)
    if not arguments:
        complain(f"name a command: {', '.join(COMMANDS)}; see 'hvs --help'")
        raise SystemExit(USER_ERROR)
    name, *rest = arguments
    if name in ("-h", "--help"):
        print(_overview())
        raise SystemExit(0)
    if name == "--version":
        import hvs_suite

        print(f"hvs {hvs_suite.__version__}")
        raise SystemExit(0)
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"choose from {', '.join(COMMANDS)}"
        complain(f"unknown command {name!r}; {hint}")
        raise SystemExit(USER_ERROR)

    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            command: Command = tyro.cli(
                load(COMMANDS[name]),
                prog=f"hvs {name}",
                args=rest,
                config=PARSER,
            )
    except SystemExit as end:
        if end.code in (0, None):
            raise
        complain(f"{_reason(errors.getvalue())}; see 'hvs {name} --help'")
        raise SystemExit(USER_ERROR) from None
    return command


def _import_plugins(arguments: Sequence[str]) -> Sequence[str]:
    """Import the modules that ``--plugin MODULE`` before the command names; the words after them.

    Worker processes find them in the environment and import them too.

    Raises:
        OptionError: One of them cannot be imported.
    """
    modules = []
    while arguments and arguments[0].partition("=")[0] == "--plugin":
        name, equals, module = arguments[0].partition("=")
        arguments = arguments[1:]
        if not equals:
            module, arguments = next(iter(arguments), ""), arguments[1:]
        if not all(word.isidentifier() for word in module.split(".")):
            raise OptionError(f"{name} names a module such as my_tasks, not {module!r}")
        modules.append(module)
    if modules:
        from hvs_suite.tasks.shared.family import PLUGINS, import_family

        # As for Python's own -m, a module may lie where the command is given.
        sys.path.insert(0, str(Path.cwd()))
        for module in modules:
            import_family(module)
        os.environ[PLUGINS] = ",".join(filter(None, [os.environ.get(PLUGINS), *modules]))
    return arguments


def load(where: str) -> Any:
    """Import the dataclass named ``module:Class``, as `COMMANDS` has it."""
    module, _, name = where.partition(":")
    return getattr(importlib.import_module(module), name)


def _overview() -> str:
    """Help of ``hvs`` itself: each command with the first line of its description."""
    lines = [
        "usage: hvs [--plugin MODULE] COMMAND [OPTIONS]",
        "",
        "Benchmark suite for hybrid visual servoing with a KUKA LBR iiwa 7.",
        "",
    ]
    for name, where in COMMANDS.items():
        summary = (inspect.getdoc(load(where)) or "").partition("\n")[0]
        lines.append(f"  {name:<16}{summary}")
    lines += [
        "",
        "'hvs COMMAND --help' explains the options of a command; --plugin imports a module that",
        "registers tasks of your own; 'hvs --version' prints the version.",
    ]
    return "\n".join(lines)


def _reason(box: str) -> str:
    """Shorten the parser's framed complaint to one paragraph, without options' help texts.

    A word that it does not know explains what it misses, and is told with the nearest that it
    knows.
    """
    paragraphs: list[list[str]] = [[]]
    for line in box.splitlines()[1:]:
        # Tyro draws its frame in ASCII where the terminal has no more.
        text = line.strip().strip("│|")
        if not text.strip(" ─╰╯-+"):
            paragraphs.append([])
        # Names of options are indented once, their help texts twice.
        elif not text.startswith(" " * 9):
            paragraphs[-1].append(text.strip())
    told = [" ".join(paragraph) for paragraph in paragraphs if paragraph]
    unknown = next((each for each in told if each.startswith("Unrecognized options")), None)
    if unknown is None:
        return next(iter(told), "the command line makes no sense")
    known = [each for each in told if each.startswith(("Missing from", "Perhaps you meant"))]
    flag, near = re.compile(r"--[a-z][a-z-]*"), []
    for typed in flag.findall(unknown):
        near += difflib.get_close_matches(typed, flag.findall(" ".join(known)), n=1)
    return f"{unknown}; did you mean {' and '.join(near)}?" if near else unknown
