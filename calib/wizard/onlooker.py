"""The engineer in front of the wizard, as a step sees it: is shown what it does, and steers it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.session.watch import Look, Watch
from ceilvo.calib.targets.marks import Click
from ceilvo.calib.targets.quality import edge_width_px, light_problem
from ceilvo.calib.targets.sources import SourceInfo
from ceilvo.calib.wizard.wire import Wire
from ceilvo.errors import CeilvoError

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_LOOKS_S = 0.12
"""From one picture that is shown to the next; those that are taken are always shown."""
_SMALL_PX = 160
"""Width of the pictures that motion is measured in."""
_LIST = 400
"""Accepted views that are listed, the latest ones."""


class Stopped(CeilvoError):
    """The engineer ended the step; its samples are kept."""


class Onlooker(Watch):
    """For one run of one step.

    Args:
        on_concluded: told the step, its rows and its problems.
        no_more: see Watch.
    """

    present = True

    def __init__(
        self,
        wire: Wire,
        on_concluded: Callable[[str, Sequence[tuple[str, str]], Sequence[str]], None],
        no_more: str = "",
    ) -> None:
        self._wire, self._on_concluded, self.no_more = wire, on_concluded, no_more
        self._live = False
        self._ended = False
        self._drops: dict[str, list[int]] = {}
        self._looked_s = 0.0
        self._small: NDArray[np.float32] | None = None
        self._rejected = 0
        self._views: tuple[str, Any] = ("", None)
        self._clicks: Array | None = None

    def opened(self, info: SourceInfo) -> None:
        self._live = info.live
        self._wire.say("source", name=info.name, live=info.live, notes=info.notes)

    def looked(self, look: Look) -> None:
        self._obey()
        self._rejected += bool(look.reason) and not look.taken
        now_s = time.monotonic()
        motion = self._motion_px(look.picture.gray)
        if not look.taken and self._live and now_s - self._looked_s < _LOOKS_S:
            return
        self._looked_s = now_s
        gray = look.picture.gray
        facts = dict(look.facts)
        corners = facts.pop("corners_px", [])
        self._list(look.part, look.views, corners)
        self._wire.say(
            "look",
            part=look.part,
            name=look.picture.name,
            reason=look.reason,
            taken=look.taken,
            size=list(gray.shape[::-1]),
            uv=look.uv_px.round(1),
            count=len(look.views),
            rejected=self._rejected,
            hint=look.hint,
            light=light_problem(gray) if gray.size else "",
            edge_px=_finite(edge_width_px(gray)) if gray.size else None,
            motion_px=motion if self._live else None,
            **facts,
        )
        if gray.size:
            self._wire.show(gray)

    def _list(self, part: str, views: Sequence[tuple[str, float | None]], corners: Any) -> None:
        told = (part, [*views])
        if told == self._views:
            return
        self._views = told
        first = max(0, len(views) - _LIST)
        rows = [[first + i, name, rms] for i, (name, rms) in enumerate(views[first:])]
        self._wire.say("views", part=part, rows=rows, corners=corners)

    def dropped(self, part: str) -> list[int]:
        self._obey()
        count = len(self._views[1] or ()) if self._views[0] == part else 0
        wanted = self._drops.pop(part, [])
        return sorted({i if i >= 0 else count + i for i in wanted if -count <= i < count}, reverse=True)

    @property
    def ended(self) -> bool:
        self._obey()
        return self._ended

    def told(self, text: str) -> None:
        self._wire.say("computing", text=text)

    def concluded(self, step: str, rows: Sequence[tuple[str, str]], problems: Sequence[str]) -> None:
        self._on_concluded(step, rows, problems)

    def click(self) -> Click | None:
        return self._click

    def _click(self, gray: Gray, names: list[str], true_px: Array | None = None) -> Array:
        """(N, 2) pixels; waits for the engineer."""
        self._wire.say("click", names=names, size=list(gray.shape[::-1]))
        self._wire.show_to_click(gray)
        self._clicks = None
        while (clicks := self._clicks_of(len(names))) is None:
            self._take(self._wire.command(wait=True))
        off = None if true_px is None else np.hypot(*(clicks - true_px).T).round(2)
        self._wire.say("clicked", off_px=off)
        return clicks

    def _clicks_of(self, count: int) -> Array | None:
        """Those that were sent, when they are as many as there are marks."""
        clicks = self._clicks
        return None if clicks is None or clicks.shape != (count, 2) else clicks

    def _obey(self) -> None:
        while (command := self._wire.command(wait=False)) is not None:
            self._take(command)

    def _take(self, command: dict[str, Any] | None) -> None:
        what = {} if command is None else command
        if what.get("do") == "stop":
            raise Stopped("stopped")
        if what.get("do") == "enough":
            self._ended = True
        elif what.get("do") == "undo" and self._views[1]:
            self._drops.setdefault(self._views[0], []).append(-1)
        elif what.get("do") == "drop" and isinstance(what.get("index"), int):
            self._drops.setdefault(str(what.get("part")), []).append(max(0, what["index"]))
        elif what.get("do") == "clicks":
            self._clicks = np.array(what.get("uv", []), np.float64)

    def _motion_px(self, gray: Gray) -> float | None:
        """From the last picture to this one, px; of two that follow one another in time it is the camera's own."""
        if not gray.size or not self._live:
            return None
        scale = _SMALL_PX / gray.shape[1]
        shape = (_SMALL_PX, max(1, round(gray.shape[0] * scale)))
        small = np.asarray(cv2.resize(gray, shape, interpolation=cv2.INTER_AREA), np.float32)
        last, self._small = self._small, small
        if last is None or last.shape != small.shape:
            return None
        (dx, dy), _ = cv2.phaseCorrelate(last, small)
        return _finite(float(np.hypot(dx, dy)) / scale)


def _finite(value: float) -> float | None:
    return round(value, 2) if np.isfinite(value) else None
