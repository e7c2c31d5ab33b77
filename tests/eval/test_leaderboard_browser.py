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
    entries = [entry(policy, task) for task in ("align-easy", "align-hard") for policy in WINS]
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


def names(view: Any, section: str) -> list[str]:
    shown: list[str] = view.locator(f"{section} .sortable tbody th:visible").all_inner_texts()
    return [name.strip() for name in shown]


def is_phone(view: Any) -> bool:
    return bool(view.viewport_size["width"] == SIZES["phone"][0])


def test_it_sorts(view: Any) -> None:
    task = "#align-easy-v1"
    assert names(view, task) == ["alpha", "gamma-long-name", "beta"]
    if is_phone(view):
        view.locator(f"{task} select").select_option(label="policy")
    else:
        view.locator(f"{task} thead button", has_text="policy").click()
    assert names(view, task) == ["alpha", "beta", "gamma-long-name"]
    if not is_phone(view):
        view.locator(f"{task} thead button", has_text="policy").click()
        assert names(view, task) == ["gamma-long-name", "beta", "alpha"]
        view.locator(f"{task} thead button", has_text="verified").click()
        assert names(view, task) == ["gamma-long-name", "alpha", "beta"]
        view.locator("#all-tasks thead button", has_text="align-hard").click()
        view.locator("#all-tasks thead button", has_text="align-hard").click()
        assert names(view, "#all-tasks") == ["beta", "gamma-long-name", "alpha"]


def test_it_searches(view: Any) -> None:
    view.locator("#search").fill("LONG gam")
    assert names(view, "#align-hard-v1") == ["gamma-long-name"]
    assert names(view, "#all-tasks") == ["gamma-long-name"]
    assert view.locator("#found").inner_text() == "1 of 3 policies"
    assert view.locator("#align-easy-v1 g[data-policy]:visible").count() == 2
    assert view.locator("#align-easy-v1 .landings figure:visible").count() == 1
    view.locator("#search").fill("nobody")
    assert names(view, "#align-hard-v1") == []
    view.locator("#search").fill("")
    assert len(names(view, "#align-hard-v1")) == 3


def test_it_opens_an_entry_and_closes_it(view: Any) -> None:
    link = view.locator("#align-hard-v1 tbody th a", has_text="beta")
    link.click()
    # An address changes before the page hears of it: opening and closing are waited for.
    sheet = view.locator("dialog[open]")
    sheet.wait_for()
    assert sheet.locator("h2").inner_text().split() == ["beta", "align-hard-v1"]
    assert sheet.locator("dl.figures").inner_text().count("3 of 10") == 1
    view.wait_for_function(
        "[...document.querySelectorAll('dialog[open] img')].every(i => i.naturalWidth === 360)"
    )
    assert sheet.locator("img").count() == 2
    assert sheet.locator("svg.landing path.hit").count() == 1
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


def test_pointing_at_a_policy_picks_out_its_curves(view: Any) -> None:
    view.locator("#align-easy-v1 .legend button", has_text="alpha").hover()
    faint = view.locator("#align-easy-v1 g.faint")
    faint.first.wait_for(state="attached")
    assert sorted({g.get_attribute("data-policy") for g in faint.all()}) == [
        "beta",
        "gamma-long-name",
    ]


def test_it_fits_the_screen_and_shows_something(view: Any, tmp_path: Path) -> None:
    from PIL import Image

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
