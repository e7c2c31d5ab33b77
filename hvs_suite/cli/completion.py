"""``hvs completion``: the shell completes commands and their options."""

import contextlib
import dataclasses
import io
import os
from pathlib import Path
from typing import Annotated, Literal

import tyro

SHELLS = {
    "bash": ("XDG_DATA_HOME", ".local/share", "bash-completion/completions/hvs"),
    "fish": ("XDG_CONFIG_HOME", ".config", "fish/completions/hvs.fish"),
    "zsh": ("ZDOTDIR", "", ".zfunc/_hvs"),
}
"""Variable, folder below the home that stands in for it, and a completion's place below either."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Completion:
    """Print the script by which a shell completes the commands and options of hvs.

    Attributes:
        shell: bash, fish or zsh.
        install: Write it to where the shell looks for it instead.
    """

    shell: Annotated[tyro.conf.Positional[Literal["bash", "fish", "zsh"]], tyro.conf.arg()]
    install: bool = False

    def run(self) -> None:
        """Print or install it."""
        from hvs_suite.files import replacing

        script = _script(self.shell)
        if not self.install:
            print(script, end="")
            return
        variable, folder, place = SHELLS[self.shell]
        path = Path(os.environ.get(variable) or Path.home() / folder, place)
        with replacing(path) as temporary:
            temporary.write_text(script, encoding="utf-8")
        print(f"wrote {path}; new shells complete hvs")
        if self.shell == "bash":
            print(f"if they do not, bash-completion is missing: add 'source {path}' to ~/.bashrc")
        elif self.shell == "zsh":
            print(f"~/.zshrc needs, before compinit: fpath+=({path.parent})")


def _script(shell: str) -> str:
    """The script of all commands, as the parser makes it."""
    from hvs_suite.cli.main import COMMANDS, PARSER, load

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            {name: load(where) for name, where in COMMANDS.items()},
            prog="hvs",
            args=["--tyro-print-completion", shell],
            config=PARSER,
        )
    return script.getvalue()
