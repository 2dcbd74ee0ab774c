"""The live page in a real browser, watching a real run; left out where there is no Chromium."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from live_page import address

if TYPE_CHECKING:
    from conftest import Cli, Start

pytest.importorskip("playwright", reason="the package playwright drives the browser")
from playwright.sync_api import Page, expect, sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
]
NODES = 6
PATIENCE_MS = 30_000
expect.set_options(timeout=PATIENCE_MS)
RUN = (
    *("--nodes", str(NODES), "--initial", "chapter", "--no-plot", "--live"),
    *("--realtime", "--tick", "0.02", "--hold-ticks", "100000", "--ticks"),
)
INKED = """canvas => {
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let inked = 0;
  for (let i = 3; i < pixels.length; i += 4) if (pixels[i] > 0) inked += 1;
  return inked;
}"""
PICTURE = "canvas => canvas.toDataURL()"
CELLS = "cells => cells.map(cell => cell.className)"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"), executable_path=CHROMIUM, headless=True, args=FLAGS
        )
        yield context
        context.close()


class Visit:
    """One open page; remembers what it complained about."""

    def __init__(self, browser: Any, url: str, width: int = 1280, height: int = 800) -> None:
        self.page: Page = browser.new_page()
        self.page.set_viewport_size({"width": width, "height": height})
        self.complaints: list[str] = []
        self.asked: set[str] = set()
        self.page.on(
            "console",
            lambda said: self.complaints.append(said.text) if said.type != "log" else None,
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.asked.add(request.url))
        self.page.goto(url)

    def tick(self) -> int:
        text = self.page.inner_text("#tick")
        return int(text) if text.isdigit() else -1

    def wait_for_tick(self, least: int) -> None:
        self.page.wait_for_function(
            "least => Number(document.getElementById('tick').textContent) >= least",
            arg=least,
            timeout=PATIENCE_MS,
        )

    def cells(self, row: str) -> list[str]:
        names = self.page.eval_on_selector_all(f'#nodes i[data-row="{row}"]', CELLS)
        assert isinstance(names, list)
        return names


def url_of(cli: Cli) -> str:
    cli.wait_for("live at ")
    return f"http://127.0.0.1:{address(cli.err)}/"


def test_the_page_shows_the_running_arm_and_how_it_ends(
    start: Start, browser: Any, tmp_path: Path
) -> None:
    cli = start.run(*RUN, "1000000")
    url = url_of(cli)
    visit = Visit(browser, url)
    page = visit.page
    visit.wait_for_tick(20)
    expect(page.locator("#state")).to_have_text("running")
    for canvas in ("arm", "errors", "curvature", "links"):
        assert page.eval_on_selector(f"#{canvas}", INKED) > 200, canvas
    before = page.eval_on_selector("#arm", PICTURE)
    tick = visit.tick()
    visit.wait_for_tick(tick + 50)
    assert page.eval_on_selector("#arm", PICTURE) != before
    assert visit.cells("alive") == ["good"] * NODES
    expect(page.locator('#nodes i[data-row="on_time"].good')).to_have_count(NODES)
    assert len(visit.cells("valid")) == NODES
    facts = page.request.get(f"{url}run.json").json()
    assert page.inner_text("#setpoint") == facts["setpoint_names"][facts["setpoint"]]
    assert page.inner_text("#ticks") == "of 1000000"
    for figure, unit in (("time", " s"), ("wall", " s"), ("p50", " ms"), ("tip-error", " mm")):
        assert float(page.inner_text(f"#{figure}").removesuffix(unit)) >= 0.0
    assert "slowest: " in page.inner_text("#links-read")
    page.hover("#links", position={"x": 600, "y": 40})
    expect(page.locator("#links-read")).to_contain_text("longest")
    assert "slowest" not in page.inner_text("#links-read")
    page.hover('#nodes i[data-row="valid"][data-node="3"]')
    expect(page.locator("#nodes-read")).to_have_text(re.compile("^node 3: alive, at tick "))
    page.screenshot(path=tmp_path / "light.png")

    page.emulate_media(color_scheme="dark")
    visit.wait_for_tick(visit.tick() + 10)
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.screenshot(path=tmp_path / "dark.png")
    page.emulate_media(color_scheme="light")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != dark

    os.kill(cli.processes()["octarm-node2"], signal.SIGKILL)
    assert cli.finish() == 4
    expect(page.locator("#state")).to_have_text("safety stop")
    expect(page.locator("#banner")).to_contain_text("node 2 was ended by SIGKILL")
    expect(page.locator('#nodes i[data-row="alive"].bad')).to_have_count(1)
    assert visit.cells("alive") == ["bad" if i == 2 else "good" for i in range(NODES)]
    expect(page.locator("body")).not_to_have_class("lost")  # it stays to be read
    assert visit.complaints == []
    assert all(one.startswith(url) for one in visit.asked)
    page.close()


@pytest.mark.every
def test_a_recording_goes_round_on_the_page(start: Start, browser: Any) -> None:
    run = start.run("--nodes", str(NODES), "--ticks", "100", "--no-plot", "--quiet")
    assert run.finish() == 0, run.err
    looping = ("--rate", "5", "--loop", "--publish", "--live", "--quiet")
    cli = start("replay", run.recording(), *looping)
    visit = Visit(browser, url_of(cli))
    visit.wait_for_tick(90)
    visit.page.wait_for_function(
        "() => Number(document.getElementById('tick').textContent) < 60", timeout=PATIENCE_MS
    )
    visit.wait_for_tick(70)
    assert visit.page.inner_text("#run").startswith("replay of ")
    expect(visit.page.locator("#state")).to_have_text("running")
    assert visit.cells("alive") == ["good"] * NODES
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    expect(visit.page.locator("#state")).to_have_text("interrupted")
    assert visit.complaints == []
    visit.page.close()


@pytest.mark.every
def test_a_lost_connection_is_said_and_greys_the_page(start: Start, browser: Any) -> None:
    cli = start.run(*RUN, "1000000")
    visit = Visit(browser, url_of(cli))
    visit.wait_for_tick(5)
    page, pid = visit.page, cli.processes()["octarm-live"]
    os.kill(pid, signal.SIGSTOP)
    expect(page.locator("#state")).to_have_text("no news")
    expect(page.locator("body")).to_have_class("lost")
    os.kill(pid, signal.SIGCONT)
    expect(page.locator("body")).to_have_class("running")
    expect(page.locator("#banner")).to_be_hidden()
    os.kill(pid, signal.SIGKILL)
    expect(page.locator("body")).to_have_class("lost")
    expect(page.locator("#state")).to_have_text("connection lost")
    expect(page.locator("#banner")).to_contain_text("without a word about the run's end")
    assert (
        page.evaluate("getComputedStyle(document.querySelector('main')).filter") == "grayscale(1)"
    )
    page.close()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130


def test_a_narrow_window_has_everything_below_each_other(
    start: Start, browser: Any, tmp_path: Path
) -> None:
    cli = start.run(*RUN, "1000000")
    visit = Visit(browser, url_of(cli), 400, 900)
    page = visit.page
    for width in (400, 700, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        visit.wait_for_tick(visit.tick() + 5)
        assert page.evaluate("document.documentElement.scrollWidth") == width
        boxes = [panel.bounding_box() for panel in page.locator(".panel").all()]
        panels = [box for box in boxes if box is not None]
        assert len(panels) == 6
        assert all(box["width"] > 150 and box["height"] > 60 for box in panels)
        for i, a in enumerate(panels):
            for b in panels[i + 1 :]:
                across = a["x"] < b["x"] + b["width"] and b["x"] < a["x"] + a["width"]
                down = a["y"] < b["y"] + b["height"] and b["y"] < a["y"] + a["height"]
                assert not (across and down)
        page.screenshot(path=tmp_path / f"{width}.png", full_page=True)
    assert visit.complaints == []
    page.close()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130


@pytest.mark.every
def test_a_finished_run_stays_on_the_page(start: Start, browser: Any) -> None:
    cli = start.run(*RUN, "60", "--by-hand", "1")
    visit = Visit(browser, url_of(cli))
    page = visit.page
    # The page is there from the first tick on.
    expect(page.locator("#state")).to_have_text("waiting for the nodes")
    cli.wait_for("node 1 is yours to start: ")
    node = start.node(str(*cli.work.glob("runs/*/node-1.json")))
    expect(page.locator("#state")).to_have_text("finished")
    assert cli.finish() in (0, 3)
    assert node.finish() == 0, node.err
    page.wait_for_timeout(300)
    expect(page.locator("body")).to_have_class("finished")
    assert visit.tick() == np.flatnonzero(~cli.recorded().late)[-1]
    assert visit.complaints == []
    page.close()


def test_a_node_that_dies_and_is_replaced_is_alive_again(
    start: Start, browser: Any, tmp_path: Path
) -> None:
    cli = start.run(*RUN, "1000000", "--restart")
    visit = Visit(browser, url_of(cli))
    page = visit.page
    visit.wait_for_tick(20)
    assert visit.cells("alive") == ["good"] * NODES
    page.evaluate(  # a short absence is seen, however fast the page is looked at
        """() => {
          window.seen = {};
          const look = () => {
            for (const cell of document.querySelectorAll("#nodes i.bad, #nodes i.fair"))
              window.seen[`${cell.dataset.row} ${cell.dataset.node}`] = cell.className;
            const text = document.getElementById("nodes-read").textContent;
            if (text.includes("out: ")) window.seen.read = text;
          };
          new MutationObserver(look).observe(document.getElementById("nodes-panel"),
            { subtree: true, attributes: true, childList: true, characterData: true });
        }"""
    )
    os.kill(cli.processes()["octarm-node2"], signal.SIGKILL)
    page.wait_for_function("() => window.seen['alive 2'] === 'bad'", timeout=PATIENCE_MS)
    page.wait_for_function("() => window.seen['on_time 2'] === 'fair'", timeout=PATIENCE_MS)
    expect(page.locator('#nodes i[data-row="alive"].good')).to_have_count(NODES)
    expect(page.locator('#nodes i[data-row="on_time"].good')).to_have_count(
        NODES, timeout=PATIENCE_MS
    )
    seen = page.evaluate("() => window.seen")
    assert "out: 2" in seen["read"]
    assert "valid 2" not in seen  # it died, and said nothing wrong
    tick = visit.tick()
    visit.wait_for_tick(tick + 50)  # and the run goes on
    page.hover('#nodes i[data-row="alive"][data-node="1"]')
    assert int(page.inner_text("#nodes-read").split(" bridged")[0].split()[-1]) > 0
    page.screenshot(path=tmp_path / "replaced.png")
    assert visit.complaints == []
    os.kill(cli.processes()["launcher"], signal.SIGINT)
    cli.finish()
    page.close()
