"""The page to click in: what a person does to it arrives, and what its script does in Chromium, if there is one."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.targets import click_page
from ceilvo.calib.targets.click_page import ClickPage

Array = NDArray[np.float64]
Run = Callable[..., tuple[int, str, str]]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def clicking(answer: Callable[[str], list[list[float]]], monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Somebody who opens each page that is announced and sends what `answer` makes of it."""
    pages: list[str] = []

    def person(url: str) -> None:
        page = urllib.request.urlopen(url, timeout=10).read().decode()
        pages.append(page)
        data = json.dumps(answer(page)).encode()
        urllib.request.urlopen(urllib.request.Request(url, data=data), timeout=10)

    def announced(text: str, **_: object) -> None:
        if "open http" in text:
            threading.Thread(target=person, args=(text.split("open ")[1].split()[0],), daemon=True).start()

    monkeypatch.setattr(click_page, "print", announced, raising=False)
    yield pages


def test_practice_shows_where_the_marks_were_and_gives_the_mounting(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clicks half a pixel off, as hands make them."""
    assert run("intrinsics", "--simulate", "--model", "pinhole")[0] == 0
    rng = np.random.default_rng(3)

    def answer(page: str) -> list[list[float]]:
        true = np.array(json.loads(page.split("truth = ")[1].split(", uv = []")[0]))
        return (true + rng.normal(0, 0.3, true.shape)).tolist()

    with clicking(answer, monkeypatch) as pages:
        code, out, err = run("projection", "--simulate", "--marks", "practice.csv")
    assert code == 0 and "practice: the virtual bench's own marks" in err, out + err
    assert len(pages) == 1 and "the disc at" in pages[0]
    found = json.loads((tmp_path / "s" / "projection.json").read_text())
    assert abs(found["height_m"] - 2.2) < 0.02
    assert json.loads(json.dumps(found["problems"])) == []


def test_the_discs_are_where_the_list_says() -> None:
    bench = VirtualBench()
    gray, xyz, uv = bench.marks()
    assert xyz.shape == (6, 3) and uv.shape == (6, 2)
    for u, v in uv:
        x, y = round(u), round(v)
        part = gray[y - 3 : y + 4, x - 3 : x + 4].astype(np.float64)
        rows, columns = np.mgrid[-3:4, -3:4]
        weight = np.clip(part - 150, 0, None)
        middle = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        assert np.hypot(*(middle + np.array([x - u, y - v]))) < 0.3


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this computer")
def test_zoom_undo_and_sending_in_a_browser(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Events as a mouse makes them: a wrong click, undo, zoom, two right clicks, send."""
    gray = np.full((48, 64), 100, np.uint8)
    cv2.circle(gray, (20, 30), 2, 255, -1)
    script = """
<script>window.addEventListener("load", () => setTimeout(() => {
  const c = document.getElementById("c");
  const at = (u, v) => { const r = c.getBoundingClientRect(), [x, y] = toCanvas(u, v);
    return {clientX: r.left + x * r.width / c.width, clientY: r.top + y * r.height / c.height, pointerId: 1}; };
  c.setPointerCapture = () => {};
  const click = (u, v) => { c.dispatchEvent(new PointerEvent("pointerdown", at(u, v)));
    c.dispatchEvent(new PointerEvent("pointerup", at(u, v))); };
  click(5, 5); document.getElementById("undo").click();
  const w = at(20, 30);
  for (let i = 0; i < 4; i++)
    c.dispatchEvent(new WheelEvent("wheel", {deltaY: -1, clientX: w.clientX, clientY: w.clientY, cancelable: true}));
  click(20.25, 30.5); click(19, 29);
  document.getElementById("send").click();
}, 200));</script>"""
    got: list[Array] = []
    monkeypatch.setattr(click_page, "_PAGE", click_page._PAGE + script)
    told: list[str] = []
    monkeypatch.setattr(click_page, "print", lambda text, **_: told.append(text), raising=False)
    thread = threading.Thread(target=lambda: got.append(ClickPage()(gray, ["a", "b"])), daemon=True)
    thread.start()
    until = time.monotonic() + 20.0
    while not told and time.monotonic() < until:
        thread.join(0.02)
    url = told[0].split("open ")[1].split()[0]
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--window-size=1280,900"]
    browser = subprocess.Popen(
        [str(CHROMIUM), *options, "--virtual-time-budget=20000", "--dump-dom", url],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        thread.join(60.0)
    finally:
        browser.kill()
        browser.wait()
    assert got, "the page sent nothing"
    np.testing.assert_allclose(got[0], [[20.25, 30.5], [19.0, 29.0]], atol=0.1)
