"""The wizard: does what the engineer asks for, one thing at a time, and says how things stand after each."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ceilvo.calib.commands import report as report_step
from ceilvo.calib.session.assemble import update_file
from ceilvo.calib.session.session import Session
from ceilvo.calib.wizard import results
from ceilvo.calib.wizard.onlooker import Onlooker, Stopped
from ceilvo.calib.wizard.pages import BY_STEP, PAGES, Page, arguments, checked_answers, described
from ceilvo.calib.wizard.undo import Undo
from ceilvo.calib.wizard.wire import Wire
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import read_calibration, write_calibration
from ceilvo.config import Config
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import calibration_path
from ceilvo.config.rendering import render_config
from ceilvo.drivers.host.machine import Machine
from ceilvo.errors import CalibrationError, CameraError, CeilvoError, one_line

REAL, PRACTICE = "commissioning", "practice"
_ANSWERS, _CONFIG = "wizard/answers.json", "wizard/config.yaml"
_AFTER_S = 5.0
"""A result that is newer than its rows by more was made on the command line."""
_EARLIER_S = 0.001


@dataclass(frozen=True)
class Place:
    """Whom the wizard works for.

    Attributes:
        config: in force; config_file: where it came from, None = the defaults.
        folder: that sessions are kept in.
        simulate: the robot is the simulated one: practice is all there is, and may be put into its configuration.
    """

    config: Config
    config_file: Path | None
    folder: Path
    simulate: bool = False


class Bench:
    """For one thread."""

    def __init__(self, place: Place, wire: Wire) -> None:
        self._place, self._wire = place, wire
        self._practice = place.simulate
        self._error = self._note = ""
        self._said: dict[str, Any] = {}

    @property
    def session(self) -> Session:
        return Session(self._place.folder / (PRACTICE if self._practice else REAL))

    def obey(self, command: Mapping[str, Any]) -> None:
        """One command to its end; what went wrong is said, in one line."""
        does: dict[str, Callable[[Mapping[str, Any]], None]] = {
            "look": lambda c: None, "practice": self._choose, "start": self._start, "drop": self._drop,
            "undo": self._undo, "apply": self._apply, "report": self._report,
        }  # fmt: skip
        action = does.get(str(command.get("do")))
        if action is None:
            return
        if command.get("do") != "look":
            self._error = self._note = ""
        try:
            action(command)
        except Stopped:
            self._note = "stopped; what was taken is kept, go on whenever you like"
        except CeilvoError as e:
            self._error = one_line(str(e).split("\n")[0], 600)
        self.tell()

    # -- commands

    def _choose(self, command: Mapping[str, Any]) -> None:
        self._practice = bool(command.get("on")) or self._place.simulate
        self._said.clear()

    def _start(self, command: Mapping[str, Any]) -> None:
        """Modes: go = take pictures, after those that are there; anew = without them; compute = only those."""
        page = BY_STEP.get(str(command.get("step")))
        if page is None:
            raise CalibrationError(f"found no step {one_line(command.get('step'))!r}, expected {', '.join(BY_STEP)}")
        mode, session = str(command.get("mode", "go")), self.session
        answers = self._answers() | {page.step: checked_answers(page, dict(command.get("answers") or {}))}
        session.write(_ANSWERS, json.dumps(answers))
        if session.result_there(page.step) or mode == "anew":
            Undo(session.folder).keep(f"{page.title} done again")
            with contextlib.suppress(FileNotFoundError):
                (session.folder / f"{page.step}.json").unlink()
        if mode == "anew":
            for part in page.parts:
                session.set_aside(part)
        no_more = self._taken_from(session, page) if mode == "compute" else ""
        watch = Onlooker(self._wire, self._conclude, no_more)
        args = arguments(page, answers[page.step], session, self._source(session), calibration=None)
        args.watch = watch
        self.tell(busy={"step": page.step, "title": page.title, "computing": bool(no_more)})
        try:
            args.run(args)
        except CameraError as e:
            raise CameraError(f"{e}{self._holders()}") from None

    def _taken_from(self, session: Session, page: Page) -> str:
        """The source of the views that are there."""
        heads = [lines[0] for part in page.parts if (lines := session.sample_lines(part))]
        if not heads:
            raise CalibrationError(f"{page.title}: found no accepted views, take some first")
        return str(heads[0].get("source", ""))

    def _source(self, session: Session) -> list[str]:
        if self._practice:
            return ["--simulate"]
        session.write(_CONFIG, render_config(self._place.config))
        return ["--config", str(session.folder / _CONFIG)]

    def _holders(self) -> str:
        """Who has the camera, where that can be seen."""
        try:
            node = os.path.realpath(self._place.config.camera.device)
            found = [] if self._practice else Machine().holders(node)
        except OSError:
            return ""
        return f"; {', '.join(found)} has it: 'sudo systemctl stop ceilvod', and try again" if found else ""

    def _conclude(self, step: str, rows: Sequence[tuple[str, str]], problems: Sequence[str]) -> None:
        self.session.write(f"wizard/{step}.json", json.dumps({"rows": [list(r) for r in rows]}))

    def _drop(self, command: Mapping[str, Any]) -> None:
        part, index = str(command.get("part")), command.get("index")
        if part not in {p for page in PAGES for p in page.parts} or not isinstance(index, int):
            raise CalibrationError(f"found no list {one_line(part)!r} with a view {one_line(index)!r}")
        session = self.session
        Undo(session.folder).keep("a view deleted")
        session.drop_sample(part, index)
        self._note = "deleted; 'Compute again' makes the step without it"

    def _undo(self, command: Mapping[str, Any]) -> None:
        self._note = f"taken back: {Undo(self.session.folder).back()}"
        if self.session.result("projection"):
            update_file(Session(self.session.folder, force=True))

    def _apply(self, command: Mapping[str, Any]) -> None:
        """Put the calibration where the configuration says; the old file is kept."""
        place, session = self._place, self.session
        if self._practice and not place.simulate:
            raise CalibrationError("this was practice: a robot's configuration is for what its own camera saw")
        if place.config_file is None:
            raise CalibrationError("found no configuration file; start 'ceilvod web' with --config FILE")
        calibration = read_calibration(session.calibration_file)
        state, said = scale_of(calibration)
        if state == "contradicted":
            raise CalibrationError(f"not put in: {said}")
        cross_check(place.config, calibration, str(place.config_file))
        to = calibration_path(place.config, place.config_file)
        there = to.exists()
        try:
            write_calibration(to, calibration, force=True)
        except CalibrationError as e:
            raise CalibrationError(f"{e}; or by hand: sudo cp {session.calibration_file} {to}") from None
        kept = f"; the old one is {to.name}.bak" if there else ""
        self._note = f"{to}: written{kept}; 'sudo systemctl restart ceilvod' takes it"

    def _report(self, command: Mapping[str, Any]) -> None:
        document = report_step.report(self.session, report_step.told(self.session))
        self._note = f"{' and '.join(str(p) for p in report_step.save(self.session, document))}: written"

    # -- how things stand

    def tell(self, busy: Mapping[str, Any] | None = None) -> None:
        session = self.session
        answers = self._answers()
        steps, before_s = [], 0.0
        for page in PAGES:
            result, damaged = self._result(session, page.step)
            stamp_s = _modified_s(session.folder / f"{page.step}.json")
            done = result is not None
            steps.append(
                described(page, answers.get(page.step, {}))
                | {
                    "done": done,
                    "verdict": str(result.get("verdict", "")) if result else "",
                    "words": results.verdict(page.step, result) if result else damaged,
                    "rows": self._rows(session, page.step, stamp_s) if done else [],
                    "outdated": done and stamp_s + _EARLIER_S < before_s,
                    "changed": done and any(_modified_s(_samples(session, p)) > stamp_s for p in page.parts),
                    "counts": {p: max(0, len(session.sample_lines(p)) - 1) for p in page.parts},
                }
            )
            if done and not page.optional:
                before_s = max(before_s, stamp_s)
            self._tell_result(session, page, result, stamp_s)
        to = None if self._place.config_file is None else calibration_path(self._place.config, self._place.config_file)
        self._wire.say(
            "state", busy=busy, practice=self._practice, simulate=self._place.simulate, steps=steps,
            folder=str(session.folder), file=self._file(session), undo=Undo(session.folder).what, error=self._error,
            note=self._note, target="" if to is None else str(to), target_there=to is not None and to.exists(),
            camera=self._place.config.camera.device,
        )  # fmt: skip

    def _result(self, session: Session, step: str) -> tuple[dict[str, Any] | None, str]:
        try:
            return session.result(step), ""
        except CalibrationError as e:
            return None, one_line(e)

    def _tell_result(self, session: Session, page: Page, result: Mapping[str, Any] | None, stamp_s: float) -> None:
        """Plots and accepted views, when they are others than were told."""
        stamp = [stamp_s, *(_modified_s(_samples(session, p)) for p in page.parts), self._practice]
        if self._said.get(page.step) == stamp:
            return
        self._said[page.step] = stamp
        shown = [] if result is None else results.plots(session, page.step, result)
        self._wire.say("result", step=page.step, plots=shown)
        shots = [] if result is None else result.get("shots") or []
        rms = {str(s.get("name")): s.get("rms_px") for s in shots if isinstance(s, dict)}
        for part in page.parts:
            names = [str(record.get("name")) for record in session.sample_lines(part)[1:]]
            rows = [[i, name, rms.get(name)] for i, name in enumerate(names)]
            self._wire.say("views", part=part, rows=rows, corners=[])

    def _rows(self, session: Session, step: str, stamp_s: float) -> list[Any]:
        path = session.folder / "wizard" / f"{step}.json"
        if _modified_s(path) + _AFTER_S < stamp_s:
            return []
        return list(_json(path).get("rows", []))

    def _file(self, session: Session) -> dict[str, Any] | None:
        path = session.calibration_file
        if not path.exists():
            return None
        try:
            found = read_calibration(path)
        except CalibrationError as e:
            return {"path": str(path), "error": one_line(e)}
        state, said = scale_of(found)
        return {"path": str(path), "to_do": found.meta.get("to_do", []), "scale": state, "scale_words": said}

    def _answers(self) -> dict[str, Any]:
        found = _json(self.session.folder / _ANSWERS)
        return {k: v for k, v in found.items() if isinstance(v, dict)}


def _samples(session: Session, part: str) -> Path:
    return session.folder / f"{part}.samples.jsonl"


def _modified_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
