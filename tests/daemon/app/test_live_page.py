"""The live page in a real Chromium, beside the simulated robot: what it shows, what it sends, what it looks like."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import PROGRAM, Chromium, Page
from mcap.reader import make_reader
from page_looks import PICTURES, SIZES, kept_to_itself, whole
from patience import until
from simulated_daemon import SimulatedDaemon
from web_parts import config_for, served
from zenoh_world import free_port

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed: apt-get install chromium")
LONG_INIT = "states.tracking_frames=40"
"""4 s of frames: a session that tries every second to connect is there in time."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("chromium")) as made:
        yield made


@pytest.mark.parametrize("size", SIZES)
def test_the_page_shows_tracking_and_a_dragged_pose_reaches_the_robot(
    browser: Chromium, size: str, tmp_path: Path
) -> None:
    port, state = free_port(), tmp_path / "state"
    state.mkdir()
    with served(config_for(port, state_dir=str(tmp_path))) as address:
        page = browser.page()
        page.size(*SIZES[size], touch=size == "phone")
        page.go(f"{address}/")
        page.until("document.querySelector('#link').innerText === 'daemon not running'")
        page.picture(PICTURES / f"{size}-waiting.png")
        with SimulatedDaemon(state, tmp_path, LONG_INIT, port=port) as daemon:
            daemon.until(lambda: page.value("document.querySelector('#state').dataset.state") == "INIT", "INIT")
            daemon.until(lambda: page.value("document.querySelector('#state').dataset.state") == "TRACKING", "TRACKING")
            history = page.text("#states")
            assert history.index("TRACKING") < history.index("INIT"), "latest first"
            page.value("document.querySelector('.picture').scrollIntoView()")
            page.until("document.querySelector('#picture').naturalWidth === 640")
            page.until("document.querySelectorAll('#latency tr').length > 5")
            page.until("document.querySelector('#base-state').innerText === 'answers'")
            page.until("/by chance [0-9.]+ to [0-9.]+/.test(document.querySelector('#nis-text').innerText)")
            page.until("document.querySelector('#events').innerText.includes('INIT -> TRACKING')")
            page.value("window.scrollTo(0, 0)")
            whole(page)
            page.until("window.ceilvo.map.landmarks.length > 5")
            page.picture(PICTURES / f"{size}-light.png")
            page.size(*SIZES[size], dark=True, touch=size == "phone")
            page.picture(PICTURES / f"{size}-dark.png")
            set_and_send(page, daemon, state, size)
            page.click("#save-map")
            page.until("/^map saved: [0-9]+ landmarks/.test(document.querySelector('#reply').innerText)")
            assert (state / "map.db").exists()
            if size == "laptop":
                recorded(page, tmp_path)
        page.until("document.querySelector('#link').innerText === 'daemon not running'")
        kept_to_itself(page, address)


def recorded(page: Page, tmp_path: Path) -> None:
    """What is taken home is what the robot said."""
    page.value("document.querySelector('#show-picture').click()")  # the recording's own pictures
    page.click("#record")
    page.until(
        "/recording [0-9]+ s, ([2-9][0-9]{2} kB|[0-9.]+ MB)/.test(document.querySelector('#recording').innerText)"
    )
    page.picture(PICTURES / "laptop-recording.png")
    page.click("#record")
    page.until("document.querySelectorAll('#recording-list a').length === 1")
    page.value("document.querySelector('#recordings').open = true")
    assert page.text("#recording") == "", "it ended well"
    [file] = (tmp_path / "recordings").glob("*.mcap")
    sizes = "fetch(document.querySelector('#recording-list a').href).then(r => r.arrayBuffer()).then(b => b.byteLength)"
    assert page.value(sizes) == file.stat().st_size
    with file.open("rb") as stream:
        topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert {"/pose/figures", "/health"} <= set(topics) and topics.count("/pose/figures") > 1
    page.click("#recording-list button")
    page.until("document.querySelector('#recordings').hidden")
    assert not file.exists()


def set_and_send(page: Page, daemon: SimulatedDaemon, state: Path, size: str) -> None:
    """With the mouse on the laptop's page and with keys on the phone's; what is sent is what the fields show."""
    page.click("#set-pose")
    page.until("!document.querySelector('#pose-form').hidden")
    before = fields(page)
    metres = float(page.value("(() => { const m = window.ceilvo.map; return 1 / m.scale; })()"))
    x, y = place_on_window(page, "ghost")
    page.drag((x, y), (x + 40.0, y + 20.0))
    moved = fields(page)
    assert moved["x"] == pytest.approx(before["x"] + 40.0 * metres, abs=0.02 + 2.0 * metres)
    assert moved["y"] == pytest.approx(before["y"] - 20.0 * metres, abs=0.02 + 2.0 * metres)
    hx, hy = place_on_window(page, "handle")
    gx, gy = place_on_window(page, "ghost")
    page.drag((hx, hy), (gx, gy - 60.0))
    assert fields(page)["theta"] == pytest.approx(90.0, abs=4.0)
    page.value("document.querySelector('#map').focus()")
    page.key("]")
    page.key("ArrowLeft")
    turned = fields(page)
    assert turned["x"] == pytest.approx(moved["x"] - 0.1, abs=0.0015)
    assert turned["theta"] < 94.0
    whole(page)
    page.value("window.scrollTo(0, 0)")
    page.picture(PICTURES / f"{size}-set-pose.png")
    page.key("Enter")
    page.until("document.querySelector('#reply').dataset.ok === 'true'")
    log = state / "commands.jsonl"
    daemon.until(lambda: log.exists() and "initial_pose" in log.read_text(), "the command is in the daemon's log")
    told = next(e for e in map(json.loads, log.read_text().splitlines()) if e["command"] == "initial_pose")
    sent = json.loads(told["arguments"])
    assert sent["x_m"] == pytest.approx(turned["x"]) and sent["y_m"] == pytest.approx(turned["y"])
    assert math.degrees(sent["theta_rad"]) == pytest.approx(turned["theta"], abs=1e-6)
    until(lambda: page.value("document.querySelector('#pose-form').hidden"), "the form is closed")


def fields(page: Page) -> dict[str, float]:
    return {n: float(page.value(f"document.querySelector('#set-{n}').value")) for n in ("x", "y", "theta")}


def place_on_window(page: Page, what: str) -> tuple[float, float]:
    """Of the new pose's middle ("ghost") or handle, in pixels of the window."""
    page.value("document.querySelector('#map').scrollIntoView({block: 'center'})")
    of = "m.handle()" if what == "handle" else "m.toScreen([m.ghost.x, m.ghost.y])"
    script = f"""(() => {{
      const m = window.ceilvo.map, box = m.canvas.getBoundingClientRect(), [u, v] = {of};
      return [box.left + m.canvas.clientLeft + u, box.top + m.canvas.clientTop + v];
    }})()"""
    u, v = page.value(script)
    return float(u), float(v)
