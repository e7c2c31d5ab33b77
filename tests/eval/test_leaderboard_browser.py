"""The board's page in a real browser: from a file, without a network, on a desk and on a phone."""

import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_result_file import TOLERANCES, make_result, row

from hvs_suite.eval.board import clips
from hvs_suite.eval.board.page import page
from hvs_suite.eval.board.tables import Entry
from hvs_suite.eval.scoring import result_file

pytestmark = pytest.mark.browser

SIZES = {"desk": (1280, 900), "phone": (390, 844)}
WINS = {"alpha": 9, "beta": 3, "gamma-long-name": 6}
MISSING = ("gamma-long-name", "align-hard")


def entry(policy: str, task: str) -> Entry:
    rows = [
        row(k, success=k < WINS[policy], error=float(k), settled={"x_mm": k / 2, "y_mm": -k / 3})
        for k in range(10)
    ]
    summary = result_file.Summary.of(
        task, policy, "test", rows, tolerances=TOLERANCES, time_limit_steps=20
    )
    changed = {"episodes": rows, "summary": summary}
    return Entry(policy, make_result().model_copy(update=changed), len(policy))


def film() -> bytes:
    """Two frames of a clip's size."""
    from PIL import Image

    first, second = (Image.new("RGB", clips.SIZE, colour) for colour in ("red", "blue"))
    buffer = io.BytesIO()
    first.save(buffer, format="AVIF", save_all=True, append_images=[second], duration=100)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if program is None:
        pytest.skip("there is no chromium here; install it with apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    # Chromium's sandbox refuses to run as root, which is what containers are.
    options = ["--no-sandbox"] if os.geteuid() == 0 else []
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=program, args=options)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    entries = [
        entry(policy, task)
        for task in ("align-easy", "align-hard")
        for policy in WINS
        if (policy, task) != MISSING
    ]
    films = {
        (e.policy, e.result.summary.task): [
            clips.Clip(kind, r, film()) for kind, r in clips.choose(e.result)
        ]
        for e in entries
    }
    path = tmp_path_factory.mktemp("board") / "leaderboard.html"
    path.write_text(page(entries, films), encoding="utf-8")
    return path


@pytest.fixture(params=SIZES)
def view(request: pytest.FixtureRequest, browser: Any, board: Path) -> Iterator[Any]:
    """The opened page; what it complains of and asks for is found out at the end."""
    width, height = SIZES[request.param]
    context = browser.new_context(
        viewport={"width": width, "height": height},
        color_scheme="light" if request.param == "desk" else "dark",
        offline=True,
    )
    opened = context.new_page()
    # A browser on a busy machine takes its time; the test does not depend on it.
    opened.set_default_timeout(60_000)
    complaints: list[str] = []
    asked: list[str] = []
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("request", lambda request: asked.append(request.url))
    opened.goto(board.as_uri())
    yield opened
    context.close()
    assert complaints == []
    assert [url for url in asked if not url.startswith(("data:", board.as_uri()))] == []


def names(view: Any, part: str) -> list[str]:
    """The policies of a table, in their order."""
    shown: list[str] = view.locator(f"{part} [data-policy] th:visible").all_inner_texts()
    return [name.strip() for name in shown]


def is_phone(view: Any) -> bool:
    return bool(view.viewport_size["width"] == SIZES["phone"][0])


def sort_by(view: Any, part: str, column: str) -> None:
    if is_phone(view):
        view.locator(f"{part} select.sort").select_option(label=column)
    else:
        view.locator(f"{part} thead button", has_text=column).click()


TASK = "#align-easy-v1 .sortable"
FAMILY = "#family-align > .sortable"
ALL = "#all-families .sortable"


def test_a_task_opens_and_sorts(view: Any) -> None:
    assert names(view, TASK) == []
    view.locator("#align-easy-v1 > summary").click()
    assert names(view, TASK) == ["alpha", "gamma-long-name", "beta"]
    sort_by(view, TASK, "policy")
    assert names(view, TASK) == ["alpha", "beta", "gamma-long-name"]
    sort_by(view, TASK, "verified")
    assert names(view, TASK) == ["gamma-long-name", "alpha", "beta"]
    if not is_phone(view):
        sort_by(view, TASK, "verified")
        assert names(view, TASK) == ["beta", "alpha", "gamma-long-name"]


def test_a_family_sorts_with_what_is_missing_last(view: Any) -> None:
    assert names(view, FAMILY) == ["alpha", "beta", "gamma-long-name"]
    sort_by(view, FAMILY, "align-easy")
    assert names(view, FAMILY) == ["alpha", "gamma-long-name", "beta"]
    sort_by(view, FAMILY, "align-hard")
    assert names(view, FAMILY) == ["alpha", "beta", "gamma-long-name"]
    sort_by(view, FAMILY, "align-hard")
    assert names(view, FAMILY)[-1] == "gamma-long-name"


def test_a_family_shows_one_figure_at_a_time(view: Any) -> None:
    cells = view.locator(f"{FAMILY} [data-policy=alpha] [data-figure]:visible")
    assert cells.all_inner_texts()[0] == "90 %"
    view.locator(f"{FAMILY} select.show").select_option(label="steps to goal")
    assert cells.all_inner_texts() == ["14.0", "14.0"]
    assert view.locator(f"{FAMILY} .mean:visible").count() == 0
    # Fewer steps are better, so the first click on a heading starts with the fewest.
    sort_by(view, FAMILY, "align-easy")
    assert names(view, FAMILY) == ["beta", "gamma-long-name", "alpha"]


def test_it_can_be_used_by_keyboard(view: Any) -> None:
    if is_phone(view):
        return
    head = view.locator(f"{ALL} thead th", has_text="policy")
    head.locator("button").focus()
    view.keyboard.press("Enter")
    assert head.get_attribute("aria-sort") == "ascending"
    view.keyboard.press("Space")
    assert names(view, ALL) == ["gamma-long-name", "beta", "alpha"]
    view.locator("#align-hard-v1 > summary").focus()
    view.keyboard.press("Enter")
    assert names(view, "#align-hard-v1 .sortable") == ["alpha", "beta"]


def test_it_searches_policies_and_tasks(view: Any) -> None:
    for task in ("easy", "hard"):
        view.locator(f"#align-{task}-v1 > summary").click()
    view.locator("#search").fill("LONG gam")
    assert names(view, TASK) == ["gamma-long-name"]
    assert names(view, ALL) == ["gamma-long-name"]
    assert view.locator("#found").inner_text() == "1 of 3 policies, 1 of 2 tasks"
    assert view.locator("#align-easy-v1 g[data-policy]:visible").count() == 2
    assert view.locator("#align-easy-v1 .landings figure:visible").count() == 1
    assert not view.locator("#align-hard-v1").is_visible()
    view.locator("#search").fill("a hard")
    assert names(view, ALL) == ["alpha", "beta"]
    assert not view.locator("#align-easy-v1").is_visible()
    assert view.locator(".strip a:visible").count() == 1
    view.locator("#search").fill("nobody")
    assert names(view, ALL) == []
    assert not view.locator("#family-align").is_visible()
    view.locator("#search").fill("")
    assert len(names(view, TASK)) == 3


def test_it_opens_an_entry_and_closes_it(view: Any) -> None:
    view.locator("#align-hard-v1 > summary").click()
    link = view.locator("#align-hard-v1 tbody th a", has_text="beta")
    link.click()
    # An address changes before the page hears of it: opening and closing are waited for.
    sheet = view.locator("dialog[open]")
    sheet.wait_for()
    assert sheet.locator("h2").inner_text().split() == ["beta", "align-hard-v1"]
    assert sheet.locator("dl.figures").inner_text().count("3 of 10") == 1
    view.wait_for_function(
        "() => [...document.querySelectorAll('dialog[open] img')].every(i => i.naturalWidth > 0)"
    )
    assert sheet.locator("img").count() == 2
    assert sheet.locator("svg.landing path.hit").count() == 1
    assert sheet.locator("tbody tr:visible").count() == 4
    width = view.evaluate("(d => [d.scrollWidth, d.clientWidth])(document.querySelector('[open]'))")
    assert width[0] <= width[1]
    place = view.evaluate("scrollY")
    view.keyboard.press("Escape")
    sheet.wait_for(state="detached")
    # The reader is where they were, and the same entry opens once more.
    view.wait_for_function("place => scrollY === place", arg=place)
    link.click()
    sheet.wait_for()
    sheet.locator("header button").click()
    sheet.wait_for(state="detached")


def test_an_entry_has_an_address(view: Any, board: Path) -> None:
    view.goto("about:blank")
    view.goto(f"{board.as_uri()}#align-easy-v1/gamma-long-name")
    assert view.locator("dialog[open] h2").inner_text().startswith("gamma-long-name")


def test_a_task_has_an_address(view: Any, board: Path) -> None:
    view.goto("about:blank")
    view.goto(f"{board.as_uri()}#align-hard-v1")
    assert names(view, "#align-hard-v1 .sortable") == ["alpha", "beta"]
    assert not view.locator(TASK).is_visible()


def test_clips_play_where_they_come_into_view(view: Any) -> None:
    first = view.locator(".strip img").first
    first.scroll_into_view_if_needed()
    view.wait_for_function("() => document.querySelector('.strip img').naturalWidth === 360")
    # What is closed was not seen, and holds no picture.
    assert view.locator("dialog img[src]").count() == 0


def test_pointing_at_a_policy_picks_out_its_curves(view: Any) -> None:
    view.locator("#align-easy-v1 > summary").click()
    view.locator("#align-easy-v1 .legend button", has_text="alpha").hover()
    faint = view.locator("#align-easy-v1 g.faint")
    faint.first.wait_for(state="attached")
    assert sorted({g.get_attribute("data-policy") for g in faint.all()}) == [
        "beta",
        "gamma-long-name",
    ]


def test_it_fits_the_screen_and_shows_something(view: Any, tmp_path: Path) -> None:
    from PIL import Image

    for task in ("easy", "hard"):
        view.locator(f"#align-{task}-v1 > summary").click()
    assert view.evaluate("document.documentElement.scrollWidth <= innerWidth")
    path = tmp_path / "page.png"
    view.screenshot(path=path, full_page=True)
    with Image.open(path) as picture:
        assert picture.width == view.viewport_size["width"]
        colours = picture.convert("RGB").getcolors(1 << 24)
        assert colours is not None
        paper = max(colours)[1]
    # The dark scheme is dark, the light one light, and neither is an empty sheet.
    assert (sum(paper) > 600) == (not is_phone(view))
    assert len(colours) > 100
