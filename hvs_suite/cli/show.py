"""``hvs show``: one picture that tells what a task looks like, and its certificate."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
import tyro

from hvs_suite.cli import console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hvs_suite.tasks.shared.certificate import Certificate, Check
    from hvs_suite.tasks.shared.environment import Environment
    from hvs_suite.tasks.shared.spec import Spec

CELL_PX = 720
FIGURE_WIDTH_IN = 12.0
PANEL_IN = 3.72
ROW_IN = 0.235
DPI = 110
INK, FAINT, RULE, PASS, FAIL = "#1e2024", "#6e7278", "#d8d9d6", "#16803c", "#be1e1e"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Show:
    """Draw a task: cell and both camera images at start and goal, and its certificate.

    The certificate is also printed. Tasks that another package registers, and those that options
    change, have none.

    Attributes:
        task: A named task, such as align-thesis.
        out: Picture to write (.png), or a page of all that there is to know (.md) with the picture
            beside it.
        scenario: Index of the test scenario to draw.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    out: Path
    scenario: int = 0
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Draw the picture and print the certificate."""
        import hvs_suite
        from hvs_suite.errors import OptionError, OutputError
        from hvs_suite.files import check_writable, replacing
        from hvs_suite.registry import find
        from hvs_suite.tasks.shared import lock
        from hvs_suite.tasks.shared.certificate import load_certificate
        from hvs_suite.tasks.shared.page import page

        if self.out.suffix.lower() not in (".png", ".md"):
            raise OutputError(f"{self.out} must end in .png or .md")
        check_writable(self.out)
        options = find(self.task).options_from_text(self.option)
        has_one = lock.is_own(self.task) and not options
        certificate = load_certificate(self.task) if has_one else None
        is_page = self.out.suffix.lower() == ".md"
        # A page's picture is kept with the project: in a quarter of the bytes.
        picture = self.out.with_suffix(".webp") if is_page else self.out
        encoding = {"quality": 50, "method": 6} if is_page else {}
        if is_page and certificate is None:
            raise OptionError(f"{self.task} as asked for has no certificate to make a page of")
        with hvs_suite.load(self.task, split="test", **options) as env:
            start, goal = look(env, self.scenario)
            figure = draw(env.spec, self.scenario, start, goal, certificate)
            if is_page and certificate is not None:
                with replacing(self.out) as temporary:
                    text = page(env, certificate, picture.name)
                    temporary.write_text(text, encoding="utf-8")
        with replacing(picture) as temporary:
            figure.savefig(temporary, dpi=DPI, facecolor="white", pil_kwargs=encoding)
        if certificate is not None:
            console.print_table(
                (title(certificate), "found", "needed", ""),
                [(c.what, c.found, c.needed, verdict(c)) for c in certificate.checks],
            )
        print(f"wrote {self.out}")


@dataclasses.dataclass(frozen=True, eq=False)
class Moment:
    """How the cell looks at one moment.

    Attributes:
        caption: Which moment.
        cell: Third-person view, uint8 (H, W, 3).
        eih: Eye-in-hand image as observed, uint8 (H, W, 3).
        eth: Eye-to-hand image as observed, uint8 (H, W, 3).
    """

    caption: str
    cell: npt.NDArray[np.uint8]
    eih: npt.NDArray[np.uint8]
    eth: npt.NDArray[np.uint8]


def look(env: "Environment", scenario: int) -> tuple[Moment, Moment]:
    """Look at a scenario's start, and at its end after the expert has solved it."""
    from hvs_suite.policies.catalogue import policy_factory
    from hvs_suite.rollout import run_episode

    def moment(caption: str, observation: Any) -> Moment:
        from hvs_suite.pictures import as_rgb

        return Moment(
            caption,
            env.render(width=CELL_PX, height=CELL_PX),
            as_rgb(observation["eih"]),
            as_rgb(observation["eth"]),
        )

    last: dict[str, Any] = {}

    def keep(_seen: Any, _action: Any, _executed: Any, time_step: Any, _info: Any) -> None:
        last["observation"] = time_step.observation

    start = moment("start", env.reset(scenario=scenario).observation)
    episode = run_episode(env, policy_factory("expert", env.spec.name)(env), scenario, keep)
    how = "goal" if episode.success else "end, not solved"
    return start, moment(f"{how}, step {episode.steps} of the expert", last["observation"])


def draw(
    spec: "Spec", scenario: int, start: Moment, goal: Moment, certificate: "Certificate | None"
) -> "Figure":
    """Lay out the picture: start above goal, cell and cameras side by side, certificate below.

    Args:
        spec: The task's parameters.
        scenario: Index that was drawn.
        start: The cell after the reset.
        goal: The cell at the goal.
        certificate: The task's certificate; None leaves it out.

    Returns:
        The figure.
    """
    from matplotlib.figure import Figure

    from hvs_suite.registry import options_of
    from hvs_suite.tasks.shared.option_types import listed

    words = spec.describe()
    table_in = 0.0 if certificate is None else ROW_IN * (len(certificate.checks) + 2)
    changed = listed(options_of(spec))
    head_in, gap_in, edge_in = 1.2, 0.45, 0.25
    height = head_in + 2 * (PANEL_IN + gap_in) + table_in + edge_in
    figure = Figure(figsize=(FIGURE_WIDTH_IN, height))

    def put_text(x_in: float, y_in: float, text: str, **style: Any) -> None:
        figure.text(x_in / FIGURE_WIDTH_IN, 1 - y_in / height, text, va="top", **style)

    name = f"{spec.name}-v{spec.version}" + (f" with {changed}" if changed else "")
    put_text(edge_in, 0.2, name, size=19, weight="bold", color=INK)
    put_text(
        edge_in,
        0.62,
        f"to reach: {words.tolerance}"
        + (f", held {words.held}" if words.held else "")
        + f", within {spec.time_limit_steps} steps of {spec.control_period_s:g} s; "
        f"shown: test scenario {scenario}",
        size=10,
        color=FAINT,
    )
    varied = words.disturbances
    put_text(
        edge_in,
        0.84,
        f"start {words.start}; target: {words.target}; "
        f"disturbed: {'nothing' if varied == '-' else varied}",
        size=10,
        color=FAINT,
    )
    step = (FIGURE_WIDTH_IN - 2 * edge_in - 3 * PANEL_IN) / 2 + PANEL_IN
    for row, moment in enumerate((start, goal)):
        top = head_in + row * (PANEL_IN + gap_in)
        panels = (
            (f"cell, {moment.caption}", moment.cell, "antialiased"),
            (f"eye in hand, {moment.eih.shape[1]} px", moment.eih, "nearest"),
            (f"eye to hand, {moment.eth.shape[1]} px", moment.eth, "nearest"),
        )
        for column, (title, image, interpolation) in enumerate(panels):
            left = edge_in + column * step
            put_text(left, top, title, size=10.5, color=INK)
            axes = figure.add_axes(
                (
                    left / FIGURE_WIDTH_IN,
                    1 - (top + 0.24 + PANEL_IN) / height,
                    PANEL_IN / FIGURE_WIDTH_IN,
                    PANEL_IN / height,
                )
            )
            axes.imshow(image, interpolation=interpolation)
            axes.set_axis_off()
    if certificate is not None:
        _draw_table(put_text, height - edge_in - table_in + 0.05, edge_in, certificate)
    return figure


def title(certificate: "Certificate") -> str:
    """What a certificate is about, as a heading."""
    return f"certificate of {certificate.task}, {certificate.scenarios:,} test scenarios"


def verdict(check: "Check") -> str:
    """Whether a check holds, in a word."""
    return "ok" if check.holds else "FAILS"


def _draw_table(put_text: Any, top: float, left: float, certificate: "Certificate") -> None:
    """Write the certificate's checks, one line each."""
    columns = (left, left + 7.2, left + 9.1, left + 11.0)
    for x, heading in zip(columns, (title(certificate), "found", "needed", ""), strict=True):
        put_text(x, top, heading, size=9.5, weight="bold", color=INK)
    for index, check in enumerate(certificate.checks):
        y = top + ROW_IN * (index + 1.15)
        for x, cell in zip(columns, (check.what, check.found, check.needed), strict=False):
            put_text(x, y, cell, size=9.5, color=INK)
        colour = PASS if check.holds else FAIL
        put_text(columns[3], y, verdict(check), size=9.5, weight="bold", color=colour)
