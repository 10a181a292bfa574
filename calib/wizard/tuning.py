"""Exposure and gain while somebody looks at what they do: histogram, focus, what is white, flicker."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate.survey import flicker
from ceilvo.calib.practice.virtual_exposure import RANGES, RATE_HZ, VirtualExposure
from ceilvo.calib.targets.quality import edge_width_px, light_problem
from ceilvo.calib.targets.sources import Picture
from ceilvo.calib.wizard.bench import Place
from ceilvo.calib.wizard.configuration import change_config
from ceilvo.calib.wizard.wire import Wire
from ceilvo.config.reader import replace as replace_keys
from ceilvo.config.rendering import yaml_text
from ceilvo.drivers.camera.v4l2_camera import V4l2Camera
from ceilvo.drivers.camera.v4l2_query import query
from ceilvo.errors import BadFrameError, CameraError, CeilvoError, ConfigError, one_line

_SHOWN_S = 0.15
"""From one picture that is shown to the next."""
_LIGHT = 90
"""Frames that flicker is looked for in: three seconds."""
_BINS = 64
"""Of the histogram."""
_CELLS = (18, 24)
"""Rows and columns of the map of what is white."""
_WHITE = 253
"""Grey level of white, as ceilvo.calib.targets.quality has it."""
_KEYS = ("exposure_us", "gain")


class Tuned(Protocol):
    """A camera that can be set while it runs."""

    def frames(self) -> Iterator[Picture]: ...
    def adjust(self, exposure_us: float | None, gain: float | None) -> None: ...


class _Real:
    def __init__(self, camera: V4l2Camera) -> None:
        self._camera = camera

    def frames(self) -> Iterator[Picture]:
        while True:
            try:
                frame = self._camera.read()
            except BadFrameError:
                continue
            if frame is None:
                return
            yield Picture(f"frame {frame.seq}", frame.stamp_ns, frame.gray)

    def adjust(self, exposure_us: float | None, gain: float | None) -> None:
        self._camera.adjust(exposure_us, gain)


class _Simulated:
    def __init__(self, camera: VirtualExposure) -> None:
        self._camera = camera

    def frames(self) -> Iterator[Picture]:
        for picture in self._camera:
            yield picture
            time.sleep(1.0 / RATE_HZ)

    def adjust(self, exposure_us: float | None, gain: float | None) -> None:
        self._camera.exposure_us, self._camera.gain = exposure_us, gain


class Tuning:
    """One camera at a time, until something else is to be done."""

    def __init__(self, place: Place, wire: Wire) -> None:
        self._place, self._wire = place, wire
        self._error = self._note = ""
        self._left: dict[str, Any] | None = None

    def obey(self, command: Mapping[str, Any]) -> dict[str, Any] | None:
        """Run until stopped, or until something else is to be done, which is returned; what goes wrong is said."""
        self._error = self._note = ""
        self._left = None
        try:
            if command.get("do") == "save_camera":
                self._save(command)
            else:
                self._tune(command)
        except CeilvoError as e:
            self._error, self._note = _line(e), ""
        self._wire.say("tuning", on=False, error=self._error, note=self._note)
        return self._left

    def _save(self, command: Mapping[str, Any]) -> None:
        place, values = self._place, {f"camera.{k}": v for k, v in self._values(command).items()}
        if place.config_file is None:
            raise ConfigError("found no configuration file; start 'ceilvod web' with --config FILE")
        kept = change_config(place.config_file, values)
        said = ", ".join(f"{name}: {yaml_text(v)}" for name, v in values.items())
        self._note = (
            f"{place.config_file}: {said}; the file as it was is {kept.name}; 'sudo systemctl restart ceilvod' takes it"
        )

    def _values(self, command: Mapping[str, Any]) -> dict[str, float | None]:
        """Checked as the configuration's."""
        out: dict[str, float | None] = {}
        for key in _KEYS:
            value = command.get(key)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise ConfigError(f"camera.{key}: found {one_line(value)!r}, expected a number or null")
            out[key] = None if value is None else float(value)
        replace_keys(self._place.config, [f"camera.{k}={yaml_text(v)}" for k, v in out.items()])
        return out

    def _tune(self, command: Mapping[str, Any]) -> None:
        values = self._values(command) if "exposure_us" in command else None
        practice = bool(command.get("practice")) or self._place.simulate
        settings = self._place.config.camera
        if values is None:
            values = {"exposure_us": settings.exposure_us, "gain": settings.gain}
        with ExitStack() as held:
            tuned, ranges, name = held.enter_context(self._opened(practice, values))
            light: deque[tuple[float, float]] = deque(maxlen=_LIGHT)
            shown_s = 0.0
            for picture in tuned.frames():
                wanted = self._asked()
                if wanted is not None and wanted.get("do") == "stop":
                    break
                if wanted is not None:
                    values = self._chosen(wanted, tuned, values)
                    light.clear()
                light.append((1e-9 * picture.stamp_ns, float(picture.gray.mean())))
                if time.monotonic() - shown_s >= _SHOWN_S:
                    shown_s = time.monotonic()
                    self._show(picture, list(light), values, ranges, name)

    def _chosen(
        self, wanted: Mapping[str, Any], tuned: Tuned, values: dict[str, float | None]
    ) -> dict[str, float | None]:
        """What is set from now on; a value that the camera or the configuration refuses leaves the camera on."""
        self._error = self._note = ""
        try:
            if wanted.get("do") == "save_camera":
                self._save(wanted)
                return values
            new = self._values(wanted)
            tuned.adjust(new["exposure_us"], new["gain"])
        except CeilvoError as e:
            self._error = _line(e)
            return values
        return new

    def _asked(self) -> dict[str, Any] | None:
        """The latest of what was asked for in between."""
        latest = None
        while (command := self._wire.command(wait=False)) is not None:
            if command.get("do") in ("tune", "stop", "save_camera"):
                latest = command
            elif command.get("do") != "look":
                self._left = command
                return {"do": "stop"}
        return latest

    @contextmanager
    def _opened(
        self, practice: bool, values: Mapping[str, float | None]
    ) -> Iterator[tuple[Tuned, Mapping[str, tuple[float, float] | None], str]]:
        if practice:
            yield _Simulated(VirtualExposure(values["exposure_us"], values["gain"])), RANGES, "simulated camera"
            return
        settings = self._place.config.camera
        if settings.source != "v4l2":
            raise CameraError(f"camera.source: {settings.source}: a recording has no exposure that could be set")
        camera = V4l2Camera(replace(settings, exposure_us=values["exposure_us"], gain=values["gain"]))
        info = camera.open()
        try:
            yield _Real(camera), self._ranges(), info.name
        finally:
            camera.close()

    def _ranges(self) -> dict[str, tuple[float, float] | None]:
        """That the device tells; None where it has no such control."""
        s = self._place.config.camera
        offer = query(os.path.realpath(s.device), s.pixel_format, s.width_px, s.height_px)
        out: dict[str, tuple[float, float] | None] = {}
        for key, name, unit in (("exposure_us", "exposure", 100.0), ("gain", "gain", 1.0)):
            c = offer.controls.get(name)
            out[key] = None if c is None or not c.settable else (max(unit * c.minimum, 0.0), unit * c.maximum)
        return out

    def _show(
        self,
        picture: Picture,
        light: list[tuple[float, float]],
        values: Mapping[str, float | None],
        ranges: Mapping[str, tuple[float, float] | None],
        name: str,
    ) -> None:
        gray = picture.gray
        edge = edge_width_px(gray)
        found = flicker(light)
        self._wire.say(
            "tuning", on=True, error=self._error, note=self._note, name=name, values=values, ranges=ranges,
            size=list(gray.shape[::-1]), histogram=np.histogram(gray, _BINS, (0, 256))[0], mean=float(gray.mean()),
            white=_white(gray), white_share=float(np.mean(gray >= _WHITE)), edge_px=edge if np.isfinite(edge) else None,
            light=light_problem(gray), flicker=found.text, advice=found.exposures_us,
            enough=len(light) == _LIGHT,
        )  # fmt: skip
        self._wire.show(gray)


def _line(error: CeilvoError) -> str:
    return one_line(str(error).split("\n")[0], 600)


def _white(gray: NDArray[np.uint8]) -> list[list[float]]:
    """Share of white pixels in each part of the picture."""
    rows = np.array_split(gray >= _WHITE, _CELLS[0], axis=0)
    return [[round(float(part.mean()), 3) for part in np.array_split(row, _CELLS[1], axis=1)] for row in rows]
