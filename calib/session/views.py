"""Collecting pictures of the ceiling for a step: kept on disk as they come, rejected with a reason, resumed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.session.common import Progress, check_size, pictures
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.watch import Look, watch_of
from ceilvo.calib.session.wheels import Wheels, no_wheels
from ceilvo.calib.targets.ceiling_view import CeilingReader, GridView
from ceilvo.calib.targets.sources import Picture
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

_LIVE_FRAMES = 20_000
"""Frames looked at; 11 minutes at 30 Hz."""
ALIKE = "as one that was taken before"
"""Why a live view is not worth keeping."""
MOVED, _TURNED_RAD = 0.04, float(np.radians(5.0))
"""Of the picture's width, and turn, between two live views; chosen: neighbours would repeat each other's errors."""


@dataclass(frozen=True)
class Seen:
    """One picture that counts."""

    name: str
    label: str
    view: GridView
    wheels: Array | None = None
    stamp_ns: int = 0


@dataclass
class Collection:
    """All pictures that count, in order; rejected holds (name, reason)."""

    seen: list[Seen] = field(default_factory=list)
    rejected: list[tuple[str, str]] = field(default_factory=list)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    camera_id: str = ""
    live: bool = False

    @property
    def views(self) -> list[GridView]:
        return [s.view for s in self.seen]


Wanted = Callable[[Collection, GridView, Picture], bool]
"""Whether a live view is worth keeping."""
Enough = Callable[[Collection], bool]


def collect(
    args: argparse.Namespace,
    session: Session,
    step: str,
    camera: CameraModel,
    simulated: Iterable[Picture] | None,
    *,
    tilt_rad: tuple[float, float] | None = None,
    wanted: Wanted,
    enough: Enough,
    label: Callable[[Picture], str] = lambda p: p.label,
    wheels: Wheels = no_wheels,
    ask: str = "",
) -> Collection:
    """Read the source to its end, or a live one until there is enough.

    Args:
        ask: what to do with the robot while there is not enough.

    Raises:
        CalibrationError: no picture of the calibrated size, or the disk refuses; samples so far are kept.
        CameraError, FileFormatError: the source cannot be used.
    """
    progress, reader, watch = Progress(step), CeilingReader(camera, tilt_rad), watch_of(args)
    out = Collection()
    with pictures(args, simulated) as source:
        subject = {"source": source.info.name, "size": [camera.width_px, camera.height_px]}
        out.seen += kept(session, step, subject)
        out.camera_id, out.live = source.info.camera_id, source.info.live
        done, alike = {s.name for s in out.seen}, 0
        if out.seen:
            progress.note(f"going on with {len(out.seen)} pictures of the run before")

        def tell(picture: Picture, reason: str, view: GridView | None, taken: bool = False) -> None:
            if not watch.present:
                return
            views = [(s.name, None) for s in out.seen]
            uv = np.zeros((0, 2)) if view is None else view.uv_px
            watch.looked(Look(step, picture, reason, taken, uv, views, {}, "" if enough(out) else ask))

        for k, picture in enumerate(source):
            for index in watch.dropped(step):
                session.drop_sample(step, index)
                del out.seen[index]
            if picture.name in done and not out.live:
                continue
            if watch.ended or (out.live and (k >= _LIVE_FRAMES or enough(out))):
                break
            odometry = wheels(picture)
            reason = picture.problem or check_size(picture, (camera.width_px, camera.height_px), "the lens has")
            view = None if reason else reader(picture.gray)
            if view is not None and not view.ok:
                reason = view.reason
            if view is None or reason:
                out.rejected.append((picture.name, reason))
                (progress.tell if out.live else progress.note)(f"{picture.name}: rejected, {reason}")
                tell(picture, reason, view)
                continue
            choosy = out.live or (source.info.filmed and wanted is moved)
            if choosy and not wanted(out, view, picture):
                alike += 1
                progress.tell(f"{len(out.seen)} pictures; go on moving")
                tell(picture, ALIKE, view)
                continue
            seen = Seen(picture.name, label(picture), view, odometry, picture.stamp_ns)
            session.add_sample(step, _record(seen))
            out.seen.append(seen)
            progress.tell(f"{len(out.seen)} pictures, {len(out.rejected)} rejected")
            tell(picture, "", view, taken=True)
    watch.told(f"{len(out.seen)} pictures: computing")
    progress.end()
    out.tilt_rad = reader.tilt_rad
    if not out.seen:
        reasons = {reason for _, reason in out.rejected}
        raise CalibrationError(
            f"{step}: found no usable picture among {len(out.rejected)} ("
            f"{'; '.join(sorted(reasons)[:3]) or 'none came'}); see the reasons above"
        )
    left_out = f", {alike} left out that are like others" if alike and not out.live else ""
    progress.note(f"{len(out.seen)} pictures used, {len(out.rejected)} rejected{left_out}")
    return out


def moved(out: Collection, view: GridView, picture: Picture, fraction: float = MOVED) -> bool:
    """A live view is worth keeping when the ceiling moved in it by a fraction of its width, or turned."""
    if not out.seen:
        return True
    last = out.seen[-1].view
    d = np.hypot(*(view.uv_px[:, None] - last.uv_px[None]).transpose(2, 0, 1)).min(axis=1)
    turned = abs(float(np.angle(np.exp(4j * (view.psi_rad - last.psi_rad)))) / 4.0)
    return bool(np.median(d) > fraction * picture.gray.shape[1] or turned > _TURNED_RAD)


def kept(session: Session, step: str, subject: dict[str, Any]) -> list[Seen]:
    """Samples of an interrupted run.

    Raises:
        CalibrationError: they are of something else, or damaged.
    """
    records = session.samples(step, subject)
    with session.reading_samples(step):
        return [_seen(record) for record in records]


def _record(seen: Seen) -> dict[str, Any]:
    v = seen.view
    return {
        "name": seen.name,
        "label": seen.label,
        "stamp_ns": seen.stamp_ns,
        "uv_px": v.uv_px,
        "xy": v.xy,
        "psi_rad": v.psi_rad,
        "psi_sigma_rad": v.psi_sigma_rad,
        "wheels": seen.wheels,
    }


def _seen(record: dict[str, Any]) -> Seen:
    view = GridView(
        np.array(record["uv_px"], np.float64).reshape(-1, 2),
        np.array(record["xy"], np.float64).reshape(-1, 2),
        float(record["psi_rad"]),
        float(record["psi_sigma_rad"]),
    )
    wheels = None if record.get("wheels") is None else np.array(record["wheels"], np.float64).reshape(3)
    if view.uv_px.shape != view.xy.shape or not (np.isfinite(view.uv_px).all() and np.isfinite(view.xy).all()):
        raise ValueError(f"{len(view.uv_px)} pixels for {len(view.xy)} places, or a number that is none")
    return Seen(str(record["name"]), str(record["label"]), view, wheels, int(record["stamp_ns"]))
