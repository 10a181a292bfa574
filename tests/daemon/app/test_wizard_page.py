"""Commissioning in a real Chromium: a simulated camera, from nothing to TRACKING, by what the page shows and asks."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import PROGRAM, Chromium, Page
from page_looks import PICTURES, SIZES, kept_to_itself, whole
from simulated_daemon import SimulatedDaemon
from web_parts import config_for, served
from wizard_engineer import STEPS, Engineer
from zenoh_world import free_port

from ceilvo.calib.record import legend
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.sim.rig import simulated_calibration

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed: apt-get install chromium")
WHOLE = os.environ.get("WIZARD_SIZES", "phone").split(",")
"""Sizes at which all of it is done; `make bench-wizard` does both."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("chromium")) as made:
        yield made


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its configuration, in the folder of its sessions: /etc/ceilvo for these tests."""
    file = tmp_path_factory.mktemp("robot") / "config.yaml"
    file.write_text("robot:\n  name: robot1 # the first one\n")
    return file


def robot_config(file: Path, port: int) -> Config:
    return config_for(port, state_dir=str(file.parent))


@pytest.mark.parametrize("size", WHOLE)
def test_from_nothing_to_tracking(browser: Chromium, robot: Path, size: str, tmp_path: Path) -> None:
    port, file = free_port(), robot.parent / "calibration.yaml"
    for old in (file, robot.parent / "practice"):
        if old.exists():
            old.rename(tmp_path / old.name)
    page = browser.page()
    page.size(*SIZES[size], touch=size == "phone")
    engineer = Engineer(page, PICTURES, f"{size}-wizard")
    begin = time.monotonic()
    with served(robot_config(robot, port), robot, simulate=True) as address:
        engineer.arrive(address)
        page.click("#go")
        page.until("document.querySelectorAll('#views li').length >= 7")
        page.click("#stop")
        page.until("/stopped/.test(document.querySelector('#reply').innerText)")
        engineer.look("intrinsics-stopped")
        whole(page)
        some = engineer.views()
        page.value("document.querySelector('#views li button').click()")
        page.until(f"document.querySelectorAll('#views li').length === {some - 1}")
        kept_to_itself(page, address)
        page.do("Page.navigate", url="about:blank")
        page.until("location.protocol === 'about:'")
        page.asked.clear()
    kept = some - 1
    with served(robot_config(robot, port), robot, simulate=True) as address:  # the server starts again
        engineer.arrive(address)
        page.until(f"document.querySelectorAll('#views li').length === {kept}")
        assert page.text("#go") == "Go on"
        page.click("#go")
        engineer.finish("intrinsics")
        assert engineer.views() >= 20
        engineer.took_s["intrinsics"] = time.monotonic() - begin
        for step in STEPS[1:]:
            engineer.do(step, away=step == "mount")
        assert "scale confirmed" in page.text("#scale")
        told = engineer.apply()
        assert str(file) in told
        found = read_calibration(file)
        near_the_truth(file)
        assert scale_of(found)[0] == "confirmed"
        page.click("#report")
        page.until("!document.querySelector('#get-report').hidden")
        report = page.value("fetch('/wizard/file/report.html').then(r => r.text())")
        assert "Commissioning" in report and all(title in report for title, _ in legend.STEPS.values())
        assert page.value("fetch('/wizard/file/report.pdf').then(r => r.text())").startswith("%PDF")
        whole(page)
        engineer.look("end")
        page.size(*SIZES[size], dark=True, touch=size == "phone")
        engineer.look("end-dark")
        kept_to_itself(page, address)
        page.go(f"{address}/")
        state = tmp_path / "state"
        state.mkdir()
        with SimulatedDaemon(state, tmp_path, port=port, calibration=file) as daemon:
            shown = "document.querySelector('#state').dataset.state"
            daemon.until(lambda: page.value(shown) == "TRACKING", "TRACKING")
            engineer.took_s["to TRACKING"] = time.monotonic() - begin - sum(engineer.took_s.values())
            page.value("document.querySelector('.picture').scrollIntoView()")
            page.until("document.querySelector('#picture').naturalWidth === 640")
            engineer.look("tracking")
    rows = [f"{step:<12} {seconds:5.1f} s" for step, seconds in engineer.took_s.items()]
    print(
        f"\n{size}, seconds of the machine:", *rows, f"{'all':<12} {sum(engineer.took_s.values()):5.1f} s", sep="\n  "
    )


def near_the_truth(file: Path) -> None:
    """Of the simulated rig, by the errors that calib may make (docs/calibration.md)."""
    found, true = read_calibration(file), simulated_calibration()
    assert found.camera.fx_px == pytest.approx(true.camera.fx_px, abs=0.5)
    assert found.ceiling_height_m == pytest.approx(true.ceiling_height_m, abs=0.003)
    assert found.mount_xy_m == pytest.approx(true.mount_xy_m, abs=0.002)


@pytest.mark.parametrize("size", [size for size in SIZES if size not in WHOLE])
def test_what_was_done_looks_well_at_the_other_size(browser: Chromium, robot: Path, size: str) -> None:
    """Each step's page of the session that the test above has left."""
    page = browser.page()
    page.size(*SIZES[size], touch=size == "phone")
    engineer = Engineer(page, PICTURES, f"{size}-wizard")
    with served(robot_config(robot, free_port()), robot, simulate=True) as address:
        engineer.arrive(address)
        for step in STEPS:
            engineer.choose(step)
            page.until("document.querySelector('#verdict').dataset.verdict === 'PASS'")
            plots = {"intrinsics": 2, "projection": 1, "sigma": 2}.get(step, 0)
            page.until(f"document.querySelectorAll('#plots figcaption').length === {plots}")
            page.until("[...document.querySelectorAll('#plots figcaption')].every(e => e.innerText.length > 20)")
            whole(page)
            engineer.look(f"{step}-done")
        page.size(*SIZES[size], dark=True, touch=size == "phone")
        engineer.look("check-dark")
        undone(engineer)
        marked(engineer)
        kept_to_itself(page, address)


def undone(engineer: Engineer) -> None:
    """A deleted view comes back."""
    page = engineer.page
    engineer.choose("projection")
    views = engineer.views()
    page.value("document.querySelector('#views li button').click()")
    page.until(f"document.querySelectorAll('#views li').length === {views - 1}")
    page.until("/compute again/i.test(document.querySelector('#reply').innerText)")
    page.click("#undo")
    page.until(f"document.querySelectorAll('#views li').length === {views}")
    page.until("/a view deleted$/.test(document.querySelector('#reply').innerText)")


def marked(engineer: Engineer) -> None:
    """Marks are set with keys, wherever, so that the step fails; it comes back as it was."""
    page = engineer.page
    page.value("document.querySelector('#answer-marks').value = 'x_m,y_m\\n0,0\\n1,0'")
    page.click("#go")
    page.until("document.querySelector('#marks').open && /1 of 6/.test(document.querySelector('#marks-ask').innerText)")
    for k in range(6):
        page.value("document.querySelector('#marks-canvas').focus()")
        for name in [*["ArrowRight", "ArrowDown"][: k % 3], " "]:
            page.key(name)
    page.key("u")
    page.until("/6 of 6/.test(document.querySelector('#marks-ask').innerText)")
    page.key(" ")
    engineer.look("marks")
    assert page.value("document.querySelector('#marks').scrollWidth <= document.querySelector('#marks').clientWidth")
    page.click("#marks-send")
    page.until("!document.querySelector('#marks').open && !document.querySelector('main').classList.contains('busy')")
    page.until("document.querySelector('#verdict').dataset.verdict !== 'PASS'")
    page.click("#undo")
    page.until("document.querySelector('#verdict').dataset.verdict === 'PASS'")


@pytest.mark.parametrize("size", WHOLE)
def test_the_camera_page_finds_flicker_and_writes_what_was_chosen(browser: Chromium, size: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("camera:\n  gain: 4.0 # mine\n")
    page = browser.page()
    page.size(*SIZES[size], touch=size == "phone")
    with served(robot_config(file, free_port()), file, simulate=True) as address:
        page.go(f"{address}/camera")
        page.until("!document.querySelector('#on').disabled")
        page.click("#on")
        page.until("/100(.0)? % of it|[1-9][0-9.]* of 255/.test(document.body.innerText)")
        set_value(page, "exposure-auto", False)
        set_value(page, "exposure-us", 30000)
        set_value(page, "gain-auto", False)
        set_value(page, "gain-value", 30)
        page.until("/white/.test(document.querySelector('#hint').innerText)")
        whole(page)
        page.picture(PICTURES / f"{size}-camera-white.png")
        set_value(page, "exposure-us", 12345)
        set_value(page, "gain-value", 5)
        page.until("/50 Hz mains/.test(document.querySelector('#flicker').innerText)")
        page.click("#use-advice")
        page.until("/flicker: none/.test(document.querySelector('#flicker').innerText)")
        assert page.value("document.querySelector('#exposure-us').value") == "10000"
        whole(page)
        page.picture(PICTURES / f"{size}-camera.png")
        assert "12345" not in file.read_text() and "10000" not in file.read_text(), "nothing without a wish"
        page.click("#save")
        page.until("/config.yaml.bak/.test(document.querySelector('#reply').innerText)")
        page.click("#off")
        page.until("!document.querySelector('#on').hidden")
        kept_to_itself(page, address)
    assert "gain: 5.0 # mine" in file.read_text() and "exposure_us: 10000.0" in file.read_text()
    assert (tmp_path / "config.yaml.bak").read_text() == "camera:\n  gain: 4.0 # mine\n"


def set_value(page: Page, name: str, value: float | bool) -> None:
    what = f"e.checked = {str(value).lower()}" if isinstance(value, bool) else f"e.value = '{value}'"
    page.value(
        f"(() => {{ const e = document.querySelector('#{name}'); {what}; e.dispatchEvent(new Event('change')); }})()"
    )
