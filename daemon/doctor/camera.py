"""The doctor's checks of the camera and of its calibration."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from ceilvo.calibration import Calibration
from ceilvo.calibration_check import check_fits, scale_of
from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import calibration_path
from ceilvo.config.schema import PIXEL_FORMATS
from ceilvo.daemon.doctor.findings import Finding, Patient, fine, note, wrong
from ceilvo.drivers.camera.selection import make_camera
from ceilvo.drivers.camera.v4l2_query import Offer
from ceilvo.errors import CalibrationError, CameraError, CeilvoError, ConfigError

OLD_CALIBRATION_DAYS = 365
"""An older calibration is worth a check; chosen: lenses are knocked and ceilings renewed."""
_EXPOSURE_UNIT_US = 100.0
"""V4L2 counts exposure in 100 us (V4L2_CID_EXPOSURE_ABSOLUTE)."""


def camera(p: Patient) -> Iterator[Finding]:
    """Device, rights, formats and controls; a recording in its place must be there."""
    if p.config is None:
        return
    cfg = p.config.camera
    if cfg.source != "v4l2":
        yield _recorded_camera(p.config)
        return
    try:
        node = p.devices.resolve(cfg.device)
    except CameraError as e:
        yield wrong("camera", str(e))
        return
    if not p.machine.may_write(Path(node)):
        group = p.machine.group_of(Path(node))
        who = p.machine.user or "you"
        yield wrong("camera", f"{node}: {who} may not read and write it; 'usermod -aG {group} {who}' (group {group})")
        return
    holders = p.machine.holders(node)
    try:
        offer = p.query(node, cfg.pixel_format, cfg.width_px, cfg.height_px)
    except CameraError as e:
        yield wrong("camera", str(e))
        return
    if not offer.captures:
        yield wrong("camera", f"{node} ({offer.card}) gives no pictures; take another node: ls /dev/v4l/by-id/")
        return
    held = f", in use by {', '.join(holders)}" if holders else ""
    yield from _busy(p, f"{cfg.device} ({offer.card})", held, holders)
    yield from _format(p.config, offer)
    yield from _controls(p.config, offer)


def _busy(p: Patient, name: str, held: str, holders: list[str]) -> Iterator[Finding]:
    if holders and not p.holds_all(holders):
        yield wrong("camera", f"{name}{held}: only one can have it; is a daemon running already? end the other program")
    else:
        yield fine("camera", f"{name}{held}")


def _recorded_camera(config: Config) -> Finding:
    source = make_camera(config.camera)
    try:
        info = source.open()
    except CeilvoError as e:
        return wrong("camera", str(e))
    finally:
        source.close()
    return fine("camera", f"{info.name}: a recording, {info.width_px}x{info.height_px} at {info.rate_hz:g} Hz")


def _format(config: Config, offer: Offer) -> Iterator[Finding]:
    cfg = config.camera
    size, asked = f"{cfg.width_px}x{cfg.height_px}", cfg.pixel_format
    able = [
        f for f, sizes in offer.sizes.items() if not sizes or any(s.has(cfg.width_px, cfg.height_px) for s in sizes)
    ]
    if asked not in offer.sizes:
        known = [f for f in PIXEL_FORMATS if f in able]
        hint = f"set it to {known[0]}" if known else "take another camera"
        offered = ", ".join(offer.sizes) or "nothing"
        yield wrong("format", f"camera.pixel_format: {asked} is not offered, found {offered}; {hint}")
    elif asked not in able:
        sizes = ", ".join(str(s) for s in offer.sizes[asked])
        yield wrong("format", f"camera.width_px, height_px: {asked} is not offered at {size}, found {sizes}; take one")
    elif offer.max_rate_hz is not None and offer.max_rate_hz < 0.99 * cfg.rate_hz:
        yield wrong(
            "format",
            f"camera.rate_hz: {cfg.rate_hz:g} is more than the {offer.max_rate_hz:g} of {asked} {size}; lower it",
        )
    else:
        rate = "" if offer.max_rate_hz is None else f", up to {offer.max_rate_hz:g} Hz"
        yield fine("format", f"{asked} {size}{rate}")


def _controls(config: Config, offer: Offer) -> Iterator[Finding]:
    cfg = config.camera
    asked: dict[str, tuple[str, float]] = {}
    if cfg.exposure_us is not None:
        asked["exposure"] = ("camera.exposure_us", cfg.exposure_us / _EXPOSURE_UNIT_US)
    if cfg.gain is not None:
        asked["gain"] = ("camera.gain", cfg.gain)
    good = True
    for name, (key, value) in asked.items():
        scale = _EXPOSURE_UNIT_US if name == "exposure" else 1.0
        control = offer.controls.get(name)
        if control is None or not control.settable:
            good = False
            yield wrong("controls", f"{key}: the camera has no {name} that can be set; set it to null")
        elif not control.minimum <= value <= control.maximum:
            good = False
            low, high = scale * control.minimum, scale * control.maximum
            yield wrong("controls", f"{key}: {scale * value:g} is out of the camera's range, {low:g} to {high:g}")
    if cfg.exposure_us is None and "exposure" in offer.controls:
        yield note(
            "controls", "camera.exposure_us: null, so exposure changes with the light; fix it before calibrating"
        )
    elif good:
        yield fine("controls", ", ".join(asked) + " can be set as asked" if asked else "none is asked for")


def calibration(p: Patient) -> Iterator[Finding]:
    """There, undamaged, of this camera at this size, and not very old."""
    if p.config is None:
        return
    file = calibration_path(p.config, p.config_path)
    if not file.exists():
        yield wrong("calibration", f"{file}: no such file; commission the camera with 'calib' (docs/calibration.md)")
        return
    try:
        found = read_calibration(file)
        cross_check(p.config, found, str(p.config_path))
        check_fits(found, p.config.camera.device, _camera_id(p), found.camera.width_px, found.camera.height_px)
    except (CalibrationError, ConfigError) as e:
        yield from (wrong("calibration", problem) for problem in e.problems)
        return
    yield _age(file, found)
    state, said = scale_of(found)
    yield {"confirmed": fine, "contradicted": wrong}.get(state, note)("scale", said)


def _camera_id(p: Patient) -> str:
    """Of the camera that is plugged in; empty when there is none, which is another finding."""
    if p.config is None or p.config.camera.source != "v4l2":
        return ""
    try:
        return p.devices.identity(p.devices.resolve(p.config.camera.device))
    except CameraError:
        return ""


def _age(file: Path, found: Calibration) -> Finding:
    which = f"of {found.camera_id!r}" if found.camera_id else "of a camera that is not named"
    text = f"{file}: {found.camera.width_px}x{found.camera.height_px}, {which}"
    try:
        made = datetime.fromisoformat(found.created.replace("Z", "+00:00"))
    except ValueError:
        return fine("calibration", text)
    now = datetime.now(timezone.utc)
    days = (now - (made if made.tzinfo else made.replace(tzinfo=timezone.utc))).days
    if days > OLD_CALIBRATION_DAYS:
        return note("calibration", f"{text}, {days} days old; 'calib check' tells whether it still holds")
    return fine("calibration", f"{text}, {max(days, 0)} days old")
