"""The site in a browser: no errors, no network requests, layout on a phone, accessibility."""

from __future__ import annotations

from pathlib import Path

import pytest

from intercap_core.output.viewer.page import SCRIPT, standalone
from tests.helpers.browser import DESK, PHONE, asked, needs_chromium, serious_faults, visit

pytestmark = needs_chromium
SEQUENCE = "s01_o03"
_LEAST_LETTER_PX = 9.0  # drawn size of readable text
_TOUCHABLE_PX = 24.0  # WCAG 2.2, 2.5.8, target size (minimum)


@pytest.fixture(scope="module")
def pages(site: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Overview, a sequence's page, and its viewer alone."""
    folder = site / "site" / "sequences" / SEQUENCE
    alone = tmp_path_factory.mktemp("alone")
    (alone / SCRIPT).write_bytes((folder / SCRIPT).read_bytes())
    (alone / "index.html").write_text(standalone(SEQUENCE))
    return {
        "overview": site / "site" / "index.html",
        "sequence": folder / "index.html",
        "viewer": alone / "index.html",
    }


def test_requests_and_errors_are_recorded(tmp_path: Path) -> None:
    bad = tmp_path / "bad.html"
    bad.write_text('<img src="http://127.0.0.1:9/x.png"><script>console.error("wrong")</script>')
    with visit(bad, log=tmp_path / "bad.json") as visited:
        visited.wait("document.images[0].complete")
    assert "wrong" in visited.console
    assert asked(tmp_path / "bad.json") == {"http://127.0.0.1:9/x.png"}


@pytest.mark.parametrize(
    "name", ["overview", "sequence", pytest.param("viewer", marks=pytest.mark.full)]
)
def test_pages_print_no_errors_and_ask_for_nothing(
    pages: dict[str, Path], tmp_path: Path, name: str
) -> None:
    log = tmp_path / "log.json"
    with visit(pages[name], log=log) as visited:
        if name != "overview":
            visited.wait()
        image = visited.picture()
    assert visited.console == []
    assert not [address for address in asked(log) if not address.startswith("blob:")]
    assert image.shape[:2] == (2400, 1240) and image.std() > 10


@pytest.mark.parametrize(
    ("size", "phone", "dark"), [(DESK, False, False), (DESK, False, True), (PHONE, True, True)]
)
@pytest.mark.parametrize("name", ["overview", "sequence", "viewer"])
def test_pages_fit_the_window_and_are_accessible(
    pages: dict[str, Path], name: str, size: tuple[int, int], phone: bool, dark: bool
) -> None:
    with visit(pages[name], size=size, phone=phone, dark=dark) as visited:
        if name != "overview":
            visited.wait()
        page = visited.page
        page.evaluate("document.querySelectorAll('details').forEach((d) => d.open = true)")
        assert serious_faults(visited) == []
        # exactly the areas that scroll can be reached by the keyboard
        visited.wait(
            """[...document.querySelectorAll(".scroll")].every((area) => (area.tabIndex === 0)
              === (area.scrollWidth > area.clientWidth || area.scrollHeight > area.clientHeight))"""
        )
        found = page.evaluate(
            """() => {
              const box = (node) => node.getBoundingClientRect();
              const inner = document.documentElement.clientWidth;
              const scrolls = (node) => node.closest(".scroll");
              const beyond = [...document.querySelectorAll("main *")].filter(
                (node) => !scrolls(node) && box(node).width && box(node).right > inner + 1);
              const areas = [...document.querySelectorAll(".scroll")];
              const wide = areas.filter((area) => area.scrollWidth > area.clientWidth);
              const letters = [...document.querySelectorAll("svg text")].map((text) => {
                const svg = text.ownerSVGElement;
                const scale = box(svg).width / svg.viewBox.baseVal.width;
                return [scale * parseFloat(getComputedStyle(text).fontSize), text.textContent];
              });
              const tall = (node) => box(node.closest("label") ?? node).height;
              const controls = [...document.querySelectorAll("button, select, input, summary")];
              return {
                page: [document.documentElement.scrollWidth, inner],
                beyond: beyond.map((node) => node.outerHTML.slice(0, 120)),
                wide: wide.length,
                accuracy: [...document.querySelectorAll("#sequences th")].filter((head) =>
                  /error|F1/.test(head.innerText)).map((head) => box(head).right),
                smallest: letters.length ? letters.sort((a, b) => a[0] - b[0])[0] : [99, ""],
                targets: controls.filter((node) => box(node).width && !node.closest("th"))
                  .map((node) => [tall(node), node.outerHTML.slice(0, 90)]),
              };
            }"""
        )
    assert found["page"][0] <= found["page"][1], found["beyond"]
    assert found["beyond"] == []
    if name == "overview":  # visible without scrolling; on a phone, errors against ground truth
        shown = found["accuracy"][:4] if phone else found["accuracy"]
        assert len(found["accuracy"]) > 4 and max(shown) <= size[0]
    assert found["smallest"][0] >= _LEAST_LETTER_PX, found["smallest"]
    if phone:
        assert found["wide"] > 0 or name == "viewer"
        too_small = [what for height, what in found["targets"] if height < _TOUCHABLE_PX]
        assert too_small == []


_SHOWN = """[...document.querySelectorAll("#sequences tbody tr")]
  .filter((row) => !row.hidden).map((row) => row.cells[0].innerText)"""


def test_filters_and_columns(pages: dict[str, Path]) -> None:
    rows = _SHOWN
    with visit(pages["overview"]) as visited:
        page = visited.page
        worst_first = page.evaluate(rows)
        rank = page.locator("#sequences th", has_text="overall rank")
        assert rank.get_attribute("aria-sort") == "ascending"
        assert sorted(worst_first) == [SEQUENCE, "s01_o09"]
        form = page.locator("form.filters")
        form.get_by_label("Name").fill("O09")
        assert page.evaluate(rows) == ["s01_o09"]
        assert page.get_by_role("status").inner_text() == "1 of 2"
        form.get_by_label("Name").fill("")
        form.get_by_label("Intent").select_option("use")
        assert page.evaluate(rows) == [SEQUENCE]
        form.get_by_label("Object").select_option("cup")
        assert page.evaluate(rows) == []
        form.get_by_label("Intent").select_option("")
        form.get_by_label("Object").select_option("")

        head = page.locator("#sequences").get_by_role("button", name="sequence")
        head.focus()
        page.keyboard.press("Enter")
        assert page.evaluate(rows) == [SEQUENCE, "s01_o09"]
        page.keyboard.press("Space")
        assert page.evaluate(rows) == ["s01_o09", SEQUENCE]
        assert rank.get_attribute("aria-sort") is None
        page.get_by_role("link", name=SEQUENCE).first.click()
        page.wait_for_url("**/s01_o03/index.html")
        assert page.get_by_role("heading", level=1).inner_text() == SEQUENCE


def test_a_picture_is_enlarged_and_put_back_by_a_finger(pages: dict[str, Path]) -> None:
    with visit(pages["sequence"], size=PHONE, phone=True) as visited:
        page = visited.page
        picture = page.get_by_role("button", name="frames 0, 1, 2, 3 in every camera").first
        small = picture.bounding_box()
        picture.tap()
        large = page.locator("dialog img")
        box = large.bounding_box()
        assert small is not None and box is not None
        assert small["width"] <= PHONE[0] < box["width"]  # in its own size, to be scrolled
        assert abs(box["width"] / box["height"] - small["width"] / small["height"]) < 0.02
        page.locator("dialog").evaluate("(dialog) => { dialog.scrollLeft = 1e4; }")
        assert page.locator("dialog").evaluate("(dialog) => dialog.scrollLeft") > 0
        page.get_by_role("button", name="Close").tap()
        assert not large.is_visible()
