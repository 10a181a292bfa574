"""The wizard's process, command by command: what it says, what it keeps, what it takes back."""

from __future__ import annotations

import io
import json
import queue
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.session import common
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.watch import Look
from ceilvo.calib.targets.sources import ListSource, Picture, Source, SourceInfo
from ceilvo.calib.wizard.bench import Bench, Place
from ceilvo.calib.wizard.onlooker import Onlooker
from ceilvo.calib.wizard.tuning import Tuning
from ceilvo.calib.wizard.wire import Wire
from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.config.reader import load_config
from ceilvo.drivers.host.machine import Machine
from ceilvo.drivers.pictures import decoded

Said = list[tuple[str, Any]]


class Commands(io.RawIOBase):
    """Lines that come when the test wants them; None ends them."""

    def __init__(self) -> None:
        self.lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def __iter__(self) -> Iterator[bytes]:  # type: ignore[override]
        return iter(self.lines.get, b"")

    def give(self, **command: object) -> None:
        self.lines.put(json.dumps(command).encode() + b"\n")


class Hand:
    """A wizard in this process, and who works it."""

    def __init__(self, folder: Path, config_file: Path | None = None, simulate: bool = True) -> None:
        self.out, self.commands = io.BytesIO(), Commands()
        self.wire = Wire(self.out, self.commands, lambda: None)  # type: ignore[arg-type]
        config = Config() if config_file is None else load_config(config_file)
        self.bench = Bench(Place(config, config_file, folder, simulate), self.wire)

    def do(self, what: str, **fields: object) -> dict[str, Any]:
        """How things stand after it."""
        self.bench.obey({"do": what} | fields)
        return self.state

    @property
    def state(self) -> dict[str, Any]:
        return next(data for topic, data in reversed(self.said) if topic == "state")

    @property
    def said(self) -> Said:
        raw, at, out = self.out.getvalue(), 0, []
        while at < len(raw):
            kind, length = struct.unpack_from(">cI", raw, at)
            payload = raw[at + 5 : at + 5 + length]
            message = json.loads(payload) if kind == b"J" else {"topic": kind.decode(), "data": payload}
            out.append((message["topic"], message["data"]))
            at += 5 + length
        return out

    def step(self, name: str) -> dict[str, Any]:
        return next(s for s in self.state["steps"] if s["step"] == name)

    def looks(self) -> list[dict[str, Any]]:
        return [data for topic, data in self.said if topic == "look"]


@pytest.fixture
def hand(tmp_path: Path, short: None, projected: Path) -> Hand:
    """The practice of a robot whose lens and ceiling are known."""
    projected_into(tmp_path / "practice", projected)
    config_file = tmp_path / "config.yaml"
    config_file.write_text("camera:\n  width_px: 480\n  height_px: 360\n")
    return Hand(tmp_path, config_file)


def projected_into(folder: Path, projected: Path) -> None:
    folder.mkdir()
    for path in projected.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())


def filmed(monkeypatch: pytest.MonkeyPatch, pictures: list[Picture], each: Callable[[int], None]) -> None:
    """A live camera in place of the bench; `each` is called with the number of each picture before it comes."""

    class Live(ListSource):
        def __init__(self) -> None:
            super().__init__("camera", iter(()))
            self.info = SourceInfo("camera", "", live=True, filmed=True)

        def __iter__(self) -> Iterator[Picture]:
            for i, picture in enumerate(pictures):
                each(i)
                yield picture

    def source(*_: object) -> Any:
        return _Held(Live())

    monkeypatch.setattr(common, "_pictures", source)


class _Held:
    def __init__(self, source: Source) -> None:
        self.source = source

    def __enter__(self) -> Source:
        return self.source

    def __exit__(self, *_: object) -> None:
        pass


def test_a_step_shows_each_picture_and_ends_with_words(hand: Hand) -> None:
    assert hand.do("look")["busy"] is None
    before = hand.step("projection")
    assert before["done"] and before["verdict"] == "PASS"
    state = hand.do("start", step="sigma", answers={})
    assert state["error"] == "" and hand.step("sigma")["verdict"] == "PASS"
    assert "mm" in hand.step("sigma")["words"]
    assert next(k for k, _ in hand.step("sigma")["rows"]) == "method"
    looks = hand.looks()
    assert [look["count"] for look in looks] == list(range(1, len(looks) + 1))
    assert all(look["taken"] and len(look["uv"]) >= 6 for look in looks)
    pictures = [decoded(data) for topic, data in hand.said if topic == "P"]
    assert len(pictures) == len(looks) and all(p is not None and p.shape == (360, 480) for p in pictures)
    plots = [data["plots"] for topic, data in hand.said if topic == "result" and data["step"] == "sigma"][-1]
    assert [p["kind"] for p in plots] == ["curves", "map"]
    middle = plots[1]["values"][9 * 24 + 12]
    assert 0.0 < middle < 20.0, "mm, above the robot"


def test_a_live_camera_is_steered_between_two_pictures(
    hand: Hand, stock: dict[str, list[Picture]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Advice, a deleted view, an undone one, and enough."""

    def steer(i: int) -> None:
        if i == 4:
            hand.commands.give(do="drop", part="intrinsics", index=1)
            settle(hand)
        if i == 5:
            hand.commands.give(do="undo")
            settle(hand)
        if i == 8:
            hand.commands.give(do="enough")
            settle(hand)

    boards = [p for p in stock["board"] if not p.problem]
    filmed(monkeypatch, boards + boards, steer)
    hand.do("start", step="intrinsics", answers={})
    names = [record["name"] for record in hand.bench.session.sample_lines("intrinsics")[1:]]
    shown = [look["name"] for look in hand.looks() if look["taken"]]
    assert shown[1] not in names and shown[0] in names
    assert len(names) == len(shown) - 2
    assert len(hand.looks()) <= 9
    assert hand.looks()[0]["empty"] and "hold the board" in hand.looks()[0]["hint"]
    assert "found" in hand.state["error"] or hand.step("intrinsics")["done"]


def settle(hand: Hand) -> None:
    """Until the command has been read by its thread."""
    while hand.wire._inbox.empty():
        pass


def test_a_stopped_step_goes_on_where_it_was(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(i: int) -> None:
        if i == 3:
            hand.commands.give(do="stop")
            settle(hand)

    pictures = list(VirtualBench().stations(9, 2))
    with pytest.MonkeyPatch.context() as patch:
        filmed(patch, pictures, stop)
        state = hand.do("start", step="sigma", answers={})
    assert "stopped" in state["note"] and state["error"] == ""
    kept = hand.step("sigma")["counts"]["sigma"]
    assert 0 < kept <= 4
    again = Hand(hand.bench.session.folder.parent)  # another process
    again.do("look")
    assert again.step("sigma")["counts"]["sigma"] == kept and not again.step("sigma")["done"]
    filmed(monkeypatch, pictures[kept:], lambda i: None)
    again.do("start", step="sigma", answers={})
    assert again.step("sigma")["counts"]["sigma"] > kept


def test_a_deleted_view_is_computed_without_and_comes_back(hand: Hand) -> None:
    before = (hand.bench.session.folder / "projection.json").read_bytes()
    count = hand.do("look")["steps"][1]["counts"]["projection"]
    hand.do("drop", part="projection", index=2)
    assert hand.step("projection")["counts"]["projection"] == count - 1
    hand.do("start", step="projection", mode="compute", answers={"tile-m": 0.6})
    assert hand.state["error"] == ""
    result = hand.bench.session.result("projection")
    assert result is not None and result["pictures"] == count - 1
    assert len(result["shots"]) == count - 1 and all(0.0 < s["rms_px"] < 0.5 for s in result["shots"])
    assert (hand.bench.session.folder / "projection.json").read_bytes() != before
    hand.do("undo")
    hand.do("undo")
    assert (hand.bench.session.folder / "projection.json").read_bytes() == before
    assert hand.step("projection")["counts"]["projection"] == count
    assert "found nothing" in hand.do("undo")["error"]


def test_a_calibration_goes_into_the_configuration_by_request_only(hand: Hand, tmp_path: Path) -> None:
    hand.do("start", step="projection", mode="anew", answers={"tile-m": 0.6, "height-m": 2.2})
    assert hand.state["error"] == "" and hand.state["file"]["scale"] == "confirmed"
    target = tmp_path / "calibration.yaml"
    assert hand.state["target"] == str(target) and not target.exists()
    target.write_text("the old one\n")
    hand.do("apply")
    assert hand.state["error"] == "" and "calibration.yaml.bak" in hand.state["note"]
    assert read_calibration(target).ceiling_height_m == pytest.approx(2.2, abs=0.01)
    assert (tmp_path / "calibration.yaml.bak").read_text() == "the old one\n"


def test_the_report_is_that_of_the_command_line(hand: Hand) -> None:
    for _ in range(2):
        hand.do("report")
        assert hand.state["error"] == "" and "report.pdf" in hand.state["note"]
    folder = hand.bench.session.folder
    assert "Commissioning of practice" in (folder / "report.html").read_text()
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")


def test_a_wrong_tile_does_not_get_in(hand: Hand, tmp_path: Path) -> None:
    hand.do("start", step="projection", mode="anew", answers={"tile-m": 0.625, "height-m": 2.2})
    assert hand.step("projection")["verdict"] == "FAIL"
    hand.do("apply")
    assert "not put in" in hand.state["error"] and not (tmp_path / "calibration.yaml").exists()


def test_practice_does_not_get_into_a_robot(tmp_path: Path, projected: Path) -> None:
    projected_into(tmp_path / "practice", projected)
    file = tmp_path / "config.yaml"
    file.write_text("")
    hand = Hand(tmp_path, file, simulate=False)
    assert hand.do("practice", on=True)["practice"]
    assert "practice" in hand.do("apply")["error"]
    assert not hand.do("practice", on=False)["practice"]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ({"step": "nonsense"}, "found no step"),
        ({"step": "intrinsics", "answers": {"columns": "nine"}}, "columns: found 'nine', expected a number"),
        ({"step": "intrinsics", "answers": {"square-mm": "2,5"}}, "expected a decimal point: 2.5"),
        ({"step": "intrinsics", "answers": {"board": "cheese"}}, "board: found 'cheese', expected chessboard"),
        ({"step": "intrinsics", "answers": {"--images": "/etc"}}, "found no such field"),
        ({"step": "projection", "answers": {"tile-m": 600}}, "millimetres"),
        ({"step": "sigma", "mode": "compute"}, "found no accepted views"),
    ],
)
def test_wrong_answers_are_one_line(hand: Hand, command: dict[str, Any], says: str) -> None:
    state = hand.do("start", **command)
    assert says in state["error"] and "\n" not in state["error"]


def test_who_has_the_camera_is_said_in_one_line(
    tmp_path: Path, projected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    projected_into(tmp_path / "commissioning", projected)
    file = tmp_path / "config.yaml"
    file.write_text("camera:\n  device: /dev/null\n  width_px: 480\n  height_px: 360\n")
    monkeypatch.setattr(Machine, "holders", lambda self, node: ["ceilvod (pid 812)"] if node == "/dev/null" else [])
    error = Hand(tmp_path, file, simulate=False).do("start", step="sigma")["error"]
    assert "cannot be opened" in error and "\n" not in error
    assert error.endswith("ceilvod (pid 812) has it: 'sudo systemctl stop ceilvod', and try again")


def test_the_cameras_settings_give_way_to_a_step(hand: Hand) -> None:
    tuning = Tuning(hand.bench._place, hand.wire)
    hand.commands.give(do="start", step="sigma")
    settle(hand)
    assert tuning.obey({"do": "tune", "practice": True}) == {"do": "start", "step": "sigma"}
    told = [data for topic, data in hand.said if topic == "tuning"]
    assert told[-1] == {"on": False, "error": "", "note": ""}
    assert tuning.obey({"do": "save_camera", "exposure_us": 1.0, "gain": None}) is None
    assert "camera.exposure_us" in [data for topic, data in hand.said if topic == "tuning"][-1]["error"]


@pytest.mark.parametrize("shift_px", [(0, 0), (8, 0), (-5, 12)])
def test_motion_is_that_of_the_picture(hand: Hand, stock: dict[str, list[Picture]], shift_px: tuple[int, int]) -> None:
    still = stock["places"][0]
    moved = replace(still, gray=np.roll(still.gray, shift_px, axis=(1, 0)))
    watch = Onlooker(hand.wire, lambda *_: None)
    watch.opened(SourceInfo("camera", "", live=True))
    for picture in (still, moved):
        watch.looked(Look("check", picture, "", True, np.zeros((0, 2)), [], {}, ""))
    first, second = hand.looks()
    assert first["motion_px"] is None
    assert second["motion_px"] == pytest.approx(np.hypot(*shift_px), abs=1.0)


def test_marks_are_clicked_on_the_page(hand: Hand) -> None:
    """The virtual bench's own marks, whose places are known."""
    _, _, true_px = VirtualBench().marks()
    off = np.tile([0.3, -0.2], (len(true_px), 1))
    hand.commands.give(do="clicks", uv=[[1, 2]])  # not as many as there are marks: waited on
    hand.commands.give(do="clicks", uv=(true_px + off).tolist())
    hand.do("start", step="projection", mode="anew", answers={"tile-m": "", "marks": "x_m,y_m\n0,0\n1,0\n0,1\n1,1"})
    assert next(data["names"] for topic, data in hand.said if topic == "click")
    told = next(data["off_px"] for topic, data in hand.said if topic == "clicked")
    assert len(told) == len(true_px) and np.allclose(told, np.hypot(0.3, 0.2), atol=0.02)


def test_a_full_disk_is_said(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ceilvo.calib.wizard.undo.shutil.copy2", full)
    state = hand.do("drop", part="projection", index=0)
    assert "No space left" in state["error"] and "nothing was changed" in state["error"]
    assert Session(hand.bench.session.folder).sample_lines("projection")
