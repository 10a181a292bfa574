"""Recordings of real ceilings, which are not part of this repository: the same code as `ceilvod replay`, and pictures.

python -m ceilvo.bench.real DATA_DIR

DATA_DIR holds `ceiling_lamps` (100 frames of an upward fisheye camera on a car, lamps only, with another tracker's
output; github.com/a1k0n/cycloid) and `ceiling_still` (a photo of a tiled ceiling with its lens calibration;
github.com/UbiquityRobotics/fiducials), with `industrial` one of the pictures whose lines are marked in marked/, and
`office_rendered`, a drive path-traced by another renderer, with its truth. What is absent is left out, and a line says
so.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ceilvo import se2
from ceilvo.bench.real.lamp_grid import Judged, judge, seen
from ceilvo.bench.real.marked import standing
from ceilvo.bench.real.marked.photographs import photographs, word
from ceilvo.bench.real.office import office
from ceilvo.bench.real.recordings import recorded, starting_at
from ceilvo.bench.vision.run import save_picture
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.calibration_file import write_calibration
from ceilvo.camera import CameraModel
from ceilvo.config import Config, Features
from ceilvo.config.rendering import render_config
from ceilvo.daemon import cli
from ceilvo.daemon.replay.drawing.overlay import draw_overlay
from ceilvo.daemon.replay.trajectory import (
    Trajectory,
    TrajectoryError,
    match_stamps,
    read_tum,
    trajectory_error,
    tum_line,
)
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.edges import EdgeDetector
from ceilvo.daemon.vision.lens import for_lens
from ceilvo.daemon.vision.line_detection import find_lines
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.files import write_atomic
from ceilvo.types import Array, Crossings, Lines

CEILING_M = 2.515
"""8.25 ft: the unit of the reference's u and v."""
_NOMINAL = NoiseCurves((0.05,), (0.05,), sigma_theta_rad=0.02, r_min_m=0.0, r_max_m=6.0)
"""m, m, rad; chosen: nobody measured the noise of these cameras."""
_MATCH_NS = 10_000_000  # 10 ms; chosen: less than half a period at the nominal 30 fps
LAMP_PITCH_M = (3.048, 3.6576)
"""Lamps hang 10 and 12 ft apart (the recording's SOURCE.txt). Nobody tells ceilvo; the other tracker is built on it."""
LAMP_BARS = {"distance_median_m": 0.15, "distance_max_m": 0.4, "heading_max_deg": 2.0, "step_median_m": 0.012}
"""Bars of docs/bench.md (Recorded lamps): chosen, about twice what was found there."""


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m ceilvo.bench.real", description="Recordings of real ceilings.")
    p.add_argument("data", type=Path, metavar="DATA_DIR", help="folder that holds the recordings")
    p.add_argument("--out", type=Path, default=Path("build/real"), metavar="DIR", help="(default %(default)s)")
    p.add_argument("--json", type=Path, default=Path("build/bench/real.json"), metavar="FILE")
    p.add_argument("--stand", type=int, default=standing.FRAMES, metavar="N", help="frames under each (%(default)s)")
    args = p.parse_args(arguments)
    if args.stand < 1:
        p.error(f"--stand: found {args.stand}, expected 1 or more")
    parts: dict[str, Callable[[Path, Path], dict[str, float]]] = {
        "ceiling_lamps": lamps,
        "ceiling_still": still,
        "office_rendered": lambda folder, out: office(folder),
    }
    figures: dict[str, dict[str, float]] = {}
    try:
        for name, part in parts.items():
            folder = args.data / name
            if not folder.is_dir():
                print(f"{name}: left out, {folder} is absent")
                continue
            figures[name] = part(folder, args.out)
        figures |= {f"marked {k}": v for k, v in photographs(args.data, args.out, args.stand).items()}
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(args.json, json.dumps(figures, indent=1) + "\n")
    except CeilvoError as e:
        print(f"bench.real: {e}", file=sys.stderr)
        return e.exit_code
    return 0


# -- ceiling_lamps


def lamps(folder: Path, out: Path) -> dict[str, float]:
    """Replay the car's frames against the other tracker's path; prints a table, writes files and a plot."""
    work = out / "ceiling_lamps"
    prepare_lamps(folder, work)
    estimated = work / "estimated.tum"
    where = ["--config", str(work / "config.yaml"), "--calibration", str(work / "calibration.yaml")]
    outputs = ["--tum", str(estimated), "--jsonl", str(work / "estimates.jsonl"), "--pictures", str(work / "pictures")]
    code = cli.main(["replay", str(folder), *where, *outputs, "--reference", str(work / "reference.tum")])
    if code:
        raise FileFormatError(f"{folder}: its replay ended with exit code {code}; the lines above say why")
    est, ref = read_tum(estimated), read_tum(work / "reference.tum")
    i, j = match_stamps(est.stamp_ns, ref.stamp_ns, _MATCH_NS)
    error = trajectory_error(est.poses[i], ref.poses[j])
    figures = {
        "frames": float(len(ref.stamp_ns)),
        "frames_ok": float(_good_motions(work / "estimates.jsonl")),
        "distance_median_m": error.position_median_m,
        "distance_max_m": error.position_max_m,
        "heading_max_deg": float(np.degrees(error.heading_max_rad)),
        "step_median_m": error.step_median_m,
    }
    print(_lamps_table(figures))
    lamps_seen = seen((f.gray for f in recorded(folder)), lamps_calibration())
    pitch = np.array(LAMP_PITCH_M)
    for who, poses in (("ceilvo", est.poses), ("other", ref.poses)):
        judged = judge(lamps_seen, poses, pitch)
        print(_judged_line(who, judged))
        figures |= {f"{who}_lamps_off_m": judged.off_m, f"{who}_lamp_step_m": judged.step_m}
    plot(est, ref, error, work / "trajectories.png")
    return figures


def prepare_lamps(folder: Path, work: Path) -> None:
    """Write calibration.yaml, config.yaml and reference.tum from what SOURCE.txt tells."""
    work.mkdir(parents=True, exist_ok=True)
    reference = reference_poses(folder / "reference.txt")
    write_calibration(work / "calibration.yaml", lamps_calibration(), force=True)
    write_atomic(work / "config.yaml", render_config(lamps_config(reference[0])))
    stamps = [frame.stamp_ns for frame in recorded(folder)]
    if len(stamps) != len(reference):
        raise FileFormatError(
            f"{folder}: {len(stamps)} frames and {len(reference)} lines in reference.txt, expected as many of each"
        )
    lines = [tum_line(stamp, pose) for stamp, pose in zip(stamps, reference, strict=True)]
    write_atomic(work / "reference.tum", "".join(lines))


def lamps_calibration() -> Calibration:
    """The published lens; the camera leans back by 22 deg about the image's y axis."""
    camera = CameraModel("fisheye", 640, 480, 188.89, 188.89, 316.05, 227.16, (0.015, 0.0, 0.0, 0.0))
    rotation = mount_rotation(0.0, 0.0, float(np.radians(22.0)))
    return Calibration(camera, projection_matrix(camera, rotation, (0.0, 0.0), CEILING_M), _NOMINAL, "cycloid")


def lamps_config(start: Array) -> Config:
    """The default settings, from where the other tracker starts; a recording has no base and no Zenoh."""
    config = starting_at(start)
    return replace(config, base=replace(config.base, enabled=False), zenoh=replace(config.zenoh, enabled=False))


def reference_poses(file: Path) -> Array:
    """(N, 3) map_from_base of the other tracker: its u, v are ceiling heights, and the robot is at -(u, v), -theta."""
    try:
        table = np.loadtxt(file, ndmin=2)
    except (OSError, ValueError) as e:
        raise FileFormatError(f"{file}: cannot be read ({e}); expected 'u v theta' a line") from None
    if table.shape[1] != 3:
        raise FileFormatError(f"{file}: {table.shape[1]} columns, expected 'u v theta'")
    return np.column_stack([-CEILING_M * table[:, :2], se2.wrap_array(-table[:, 2])])


def _judged_line(who: str, j: Judged) -> str:
    return (
        f"lamps, placed by the poses of {who:6}: {1e3 * j.off_m:.0f} mm rms off the grid they hang on, drifting by "
        f"{100 * j.stretch:.1f} % of the way; a lamp moves {1e3 * j.step_m:.1f} mm from frame to frame"
    )


def _good_motions(jsonl: Path) -> int:
    """Frames with a motion of their own; the first frame starts the odometry and counts."""
    failures = [json.loads(line)["motion"]["failure"] for line in jsonl.read_text(encoding="ascii").splitlines()]
    return sum(f in (None, "first frame") for f in failures)


def _lamps_table(figures: dict[str, float]) -> str:
    rows = [f"{'ceiling_lamps against the other tracker':44}{'figure':>10}{'bar':>10}"]
    all_ok = figures["frames_ok"] >= figures["frames"]
    rows.append(
        f"{'frames with a good motion':44}{figures['frames_ok']:10.0f}{figures['frames']:10.0f}  {word(all_ok)}"
    )
    for name, bar in LAMP_BARS.items():
        rows.append(f"{name:44}{figures[name]:10.4f}{bar:10.3f}  {word(figures[name] <= bar)}")
    return "\n".join(rows)


def plot(est: Trajectory, ref: Trajectory, error: TrajectoryError, file: Path) -> None:
    """Both paths from above and their distance over time. Needs the bench extra; without it a line says so."""
    try:
        import matplotlib
    except ImportError:
        print(f"{file}: not drawn, matplotlib is missing; pip install 'ceilvo[bench]'")
        return
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    above, over_time = figure.subplots(2, 1, height_ratios=(1, 1.5))
    above.plot(ref.poses[:, 0], ref.poses[:, 1], "-", color="#0072b2", label="other tracker")
    above.plot(est.poses[:, 0], est.poses[:, 1], ".-", color="#d55e00", markersize=3, label="ceilvo")
    above.set(xlabel="x [m]", ylabel="y [m]", title="Paths on the floor (y enlarged)")
    above.legend()
    i, j = match_stamps(est.stamp_ns, ref.stamp_ns, _MATCH_NS)
    off = est.poses[i] - ref.poses[j]
    t = 1e-9 * (est.stamp_ns[i] - est.stamp_ns[0])
    over_time.plot(t, np.hypot(off[:, 0], off[:, 1]), color="#0072b2", label="distance [m]")
    over_time.plot(t, np.degrees(se2.wrap_array(off[:, 2])) / 10.0, color="#009e73", label="heading [10 deg]")
    over_time.axhline(LAMP_BARS["distance_max_m"], color="grey", linestyle=":", label="bar: 0.4 m at most")
    over_time.set(xlabel="time [s]", title=f"Difference: median {error.position_median_m:.3f} m")
    over_time.legend()
    figure.savefig(file, dpi=120)
    print(f"plot of both in {file}")


# -- ceiling_still


def still(folder: Path, out: Path) -> dict[str, float]:
    """Draw what is found in the photo; prints the dominant direction."""
    gray, calibration = _photo(folder)
    lines, crossings = see(gray, calibration)
    if lines is None:
        raise FileFormatError(f"{folder}: no lines found in the photo; the front end does not see this ceiling")
    file = out / "ceiling_still.png"
    save_picture(file, draw_overlay(gray, lines, crossings, calibration.level_view, scale=2))
    figures = {
        "direction_deg": float(np.degrees(lines.psi_rad)),
        "roll_deg": float(np.degrees(lines.tilt_rad[0])),
        "pitch_deg": float(np.degrees(lines.tilt_rad[1])),
        "lines_axis_0": float(np.count_nonzero(lines.axis == 0)),
        "lines_axis_1": float(np.count_nonzero(lines.axis == 1)),
        "crossings": float(len(crossings)) if crossings is not None else 0.0,
    }
    print("ceiling_still: " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items()) + f"; drawn in {file}")
    return figures


def see(gray: np.typing.NDArray[np.uint8], calibration: Calibration) -> tuple[Lines | None, Crossings | None]:
    """Lines and crossings of one picture with the default settings."""
    features: Features = for_lens(Config().features, calibration.level_view)
    lines = find_lines(EdgeDetector(calibration, features)(gray), features, calibration.level_view.focal_px)
    return lines, None if lines is None else cross(lines, calibration, features)


def _photo(folder: Path) -> tuple[np.typing.NDArray[np.uint8], Calibration]:
    images = sorted(folder.glob("*.jpg"))
    if len(images) != 1:
        raise FileFormatError(f"{folder}: {len(images)} jpg files, expected one")
    image = cv2.imread(str(images[0]), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileFormatError(f"{images[0]}: not an image that OpenCV can read")
    gray = np.asarray(image, np.uint8)
    return gray, still_calibration(folder / "pg_3_6mm.txt", gray.shape[1], gray.shape[0])


def still_calibration(file: Path, width_px: int, height_px: int) -> Calibration:
    """The photo's lens from its first line, `fc FX FY cc CX CY kc K1 K2 P1 P2`; level and 2.5 m below, as a guess."""
    try:
        words = file.read_text(encoding="ascii").split("\n", 1)[0].split()
        named = words[0] == "fc" and words[3] == "cc" and words[6] == "kc"
        fx, fy, cx, cy, *k = (float(w) for w in (*words[1:3], *words[4:6], *words[7:11]))
    except (OSError, ValueError, IndexError) as e:
        raise FileFormatError(f"{file}: {e}; expected 'fc FX FY cc CX CY kc K1 K2 P1 P2'") from None
    if not named:
        raise FileFormatError(f"{file}: found '{' '.join(words[:3])}', expected 'fc FX FY cc CX CY kc K1 K2 P1 P2'")
    camera = CameraModel("pinhole", width_px, height_px, fx, fy, cx, cy, (*k, 0.0))
    rotation = mount_rotation(0.0, 0.0, 0.0)
    return Calibration(camera, projection_matrix(camera, rotation, (0.0, 0.0), 2.5), _NOMINAL, "photo")
