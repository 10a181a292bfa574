"""Write what the simulated camera sees as an image folder, with the truth and the calibration beside it.

python -m ceilvo.sim.record DIR --seconds 20 --fps 15 --seed 3
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration_file import write_calibration
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.files import write_atomic
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec


def record(
    folder: Path, world: World, seconds: float, fps: float, image_format: str = "png", progress: TextIO | None = None
) -> int:
    """Fill a folder that is absent or empty with images, frames.csv, truth.tum and calibration.yaml.

    Args:
        image_format: "png" (exact) or "jpg" (quality 92).

    Returns:
        The number of frames.

    Raises:
        FileFormatError: the folder has something in it, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise FileFormatError(f"{folder}: found files in it, expected a new or empty folder; name another one")
        return _fill(folder, world, seconds, fps, image_format, progress)
    except OSError as e:
        raise FileFormatError(f"{folder}: cannot be written ({e.strerror}); check the path and its rights") from None


def _fill(folder: Path, world: World, seconds: float, fps: float, image_format: str, progress: TextIO | None) -> int:
    write_calibration(folder / "calibration.yaml", world.calibration)
    camera = SimCamera(world, fps, realtime=False, duration_s=seconds)
    camera.open()
    total = math.ceil(seconds * fps - 1e-6)
    frames, truth = ["stamp_ns,file"], ["# t x y z qx qy qz qw: base in map"]
    while (frame := camera.read()) is not None:
        name = f"{frame.seq:06d}.{image_format}"
        _write_image(folder / name, frame.gray)
        frames.append(f"{frame.stamp_ns},{name}")
        truth.append(_tum(frame.stamp_ns, world.truth_at(world.seconds(frame.stamp_ns))))
        if progress is not None and (len(frames) - 1) % 50 == 0:
            print(f"\r{len(frames) - 1}/{total} frames", end="", file=progress, flush=True)
    camera.close()
    write_atomic(folder / "truth.tum", "\n".join(truth) + "\n")
    write_atomic(folder / "frames.csv", "\n".join(frames) + "\n")
    if progress is not None:
        print(f"\r{len(frames) - 1}/{total} frames in {folder}", file=progress, flush=True)
    return len(frames) - 1


def _write_image(path: Path, gray: NDArray[np.uint8]) -> None:
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 92]
    ok, data = cv2.imencode(path.suffix, gray, fast)
    if not ok:
        raise FileFormatError(f"{path}: could not be encoded; use --format png or jpg")
    path.write_bytes(data.tobytes())


def _tum(stamp_ns: int, pose: NDArray[np.float64]) -> str:
    x, y, th = pose
    s, ns = divmod(stamp_ns, 1_000_000_000)
    return f"{s}.{ns:09d} {x:.9f} {y:.9f} 0 0 0 {math.sin(th / 2):.12f} {math.cos(th / 2):.12f}"


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m ceilvo.sim.record", description="Record the simulated camera.")
    p.add_argument("folder", type=Path, metavar="DIR", help="new or empty folder")
    p.add_argument("--seconds", type=float, default=20.0, help="length (default %(default)s)")
    p.add_argument("--fps", type=float, default=30.0, help="frames per second (default %(default)s)")
    p.add_argument("--seed", type=int, default=1, help="of ceiling, noise, slip and vibration (default %(default)s)")
    p.add_argument("--format", choices=("png", "jpg"), default="png", help="png is exact (default %(default)s)")
    world = p.add_argument_group("world")
    world.add_argument("--room-m", type=float, default=5.0, help="side of the square room (default %(default)s)")
    world.add_argument("--inset-m", type=float, default=1.0, help="path to wall (default %(default)s)")
    world.add_argument("--speed-mps", type=float, default=0.35, help="cruising speed (default %(default)s)")
    world.add_argument(
        "--tilt-deg", type=float, default=0.0, help="rocking while driving, at most (default %(default)s)"
    )
    world.add_argument("--lamps-off", action="store_true", help="daylight only")
    world.add_argument(
        "--exposure-ms", type=float, default=0.0, help="motion blur over this time (default %(default)s)"
    )
    world.add_argument("--noise", type=float, default=1.0, help="noise, times the usual (default %(default)s)")
    cal = p.add_argument_group("calibration")
    cal.add_argument("--lens", choices=("pinhole", "fisheye"), default="pinhole", help="(default %(default)s)")
    cal.add_argument("--width-px", type=int, default=640, help="(default %(default)s)")
    cal.add_argument("--height-px", type=int, default=480, help="(default %(default)s)")
    cal.add_argument("--ceiling-m", type=float, default=2.2, help="ceiling above camera (default %(default)s)")
    cal.add_argument("--mount-yaw-deg", type=float, default=2.0, help="(default %(default)s)")
    cal.add_argument("--mount-roll-deg", type=float, default=0.0, help="(default %(default)s)")
    cal.add_argument("--mount-pitch-deg", type=float, default=0.0, help="(default %(default)s)")
    return p


def _world(a: argparse.Namespace) -> World:
    calibration = simulated_calibration(
        simulated_camera(a.lens, a.width_px, a.height_px),
        yaw_rad=math.radians(a.mount_yaw_deg),
        roll_rad=math.radians(a.mount_roll_deg),
        pitch_rad=math.radians(a.mount_pitch_deg),
        ceiling_height_m=a.ceiling_m,
    )
    usual = RenderSpec()
    render = RenderSpec(
        lit=() if a.lamps_off else None,
        exposure_s=a.exposure_ms / 1e3,
        read_noise=usual.read_noise * a.noise,
        shot_noise=usual.shot_noise * a.noise**2,
    )
    spec = WorldSpec(
        seed=a.seed,
        lap=LapSpec(room_m=a.room_m, inset_m=a.inset_m, speed_mps=a.speed_mps),
        ceiling=CeilingSpec(room_m=a.room_m),
        render=render,
        tilt=TiltSpec(math.radians(a.tilt_deg)),
    )
    return World(spec, calibration)


def main(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    try:
        record(args.folder, _world(args), args.seconds, args.fps, args.format, sys.stderr)
    except CeilvoError as e:
        print(f"record: {e}", file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
