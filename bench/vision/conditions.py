"""The conditions of the vision bench: what is rendered, what the pipeline believes, and the bars it is held to."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ceilvo.bench.vision.condition import LAP, USUAL, Bar, Condition, at_least, at_most, make
from ceilvo.bench.vision.textures import PLASTER, found_ceilings
from ceilvo.calibration import Calibration, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapPath, TiltSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.surroundings import scenes
from ceilvo.sim.surroundings.surroundings import Slab, SurroundingsSpec

TURNING = replace(LAP, speed_mps=1.0, corner_radius_m=1.0 / 1.5)
ROLLING = simulated_calibration(simulated_camera(readout_s=0.020))
TWO_DEG = TiltSpec(float(np.radians(2.0)))  # rad; docs/simulation.md: tilt of up to 2 deg
T_BAR = CeilingSpec(groove_m=0.024, lip_m=0.0, groove_albedo=0.95)
"""24 mm, the usual width of an exposed T-bar; brightness chosen."""
FAINT = CeilingSpec(groove_albedo=0.66, lip_albedo=0.78)  # chosen: 13 % darker than a tile's 0.76
_DARKER_A_LEVEL = 0.0118
"""By which part a groove must be darker than the tiles beside it to be a grey level darker in the picture: measured
across joints 8 mm wide in a picture without noise, speckle and lamps."""
FULL = ("features.full_every=1",)
HANGING = {
    "step": "the half of the room 0.4 m lower",
    "beams": "beams 0.3 m deep, every 1.6 m",
    "coffers": "coffers 0.25 m deep, 1.2 m apart",
    "ducts": "ducts and cable trays that cross, below the ceiling",
    "truss": "thin bars both ways, 0.5 m below the ceiling",
    "hanging_lamps": "lamps 0.6 m below the ceiling",
    "signs": "boards that hang on edge, 0.45 m below the ceiling",
}
"""What is lower than a ceiling, by the name of its scene."""
KNOWN = "-known"
"""Ends the name of a condition whose heights are known from an earlier run."""
MOUNT_XY_M = (0.05, -0.03)  # chosen: off the centre, so that turning moves the camera


def conditions() -> tuple[Condition, ...]:
    """All of them, in the order of the table."""
    return (
        *(*_light(), *_ceilings(), *_heights(), *_in_the_way(), *_driving()),
        *(*_calibration(), *_lenses(), *_stress(), *_found_ceilings()),
    )


TIMES = {"time_median": at_most(3.5), "time_p99": at_most(8.0)}
"""Of a frame near predicted edges, filter included, over bare Canny."""
WHOLE_TIMES = {"time_median": at_most(6.0), "time_p99": at_most(12.0)}
"""Of a frame that is looked at whole."""
FEW_LINES = {"usable_way_pct": at_least(90.0), "drift_pct": at_most(0.5)}
"""Where lines alone do not suffice: of the way on which two points are in view."""


def _light() -> list[Condition]:
    crossings = {
        "recall_pct": at_least(99.0),
        "precision_pct": at_least(99.0),
        "crossing_median_px": at_most(0.08),
        "crossing_p95_px": at_most(0.5),
    }
    motion = {"motion_median_mm": at_most(0.06), "motion_median_mdeg": at_most(1.5), "worst_mm": at_most(8.0)}
    return [
        make("base", "lamps on, usual noise", bars={**crossings, **motion, **TIMES}),
        make("base-full", "the same, every frame looked at whole", overrides=FULL, bars={**crossings, **WHOLE_TIMES}),
        make("noise-x3", "three times the noise", render=noisy(3.0), bars=_found(98.0)),
        make("noise-x6", "six times the noise", render=noisy(6.0)),
        make("lamps-off", "30 % daylight only", render=replace(USUAL, lit=())),
        make("dark", "12 % daylight only", render=replace(USUAL, lit=(), daylight=0.12), bars=_found(97.0)),
        make(
            "flicker-switch",
            "lamps flicker by 30 % and are switched in three groups",
            render=replace(USUAL, flicker_depth=0.3, switch_groups=3, switch_period_s=1.7),
        ),
        make("blur-33ms", "33 ms exposure", render=replace(USUAL, exposure_s=0.033), bars=_found(94.0)),
        make("blur-66ms", "66 ms exposure", fps=15.0, render=replace(USUAL, exposure_s=0.066)),
    ]


def _ceilings() -> list[Condition]:
    never_wrong = {"wrong": at_most(0.0), "drift_pct": at_most(0.5)}
    return [
        make("faint", "grooves 13 % darker than tiles", ceiling=FAINT),
        *(_fainter(levels) for levels in (5.0, 3.0, 2.0)),
        make("t-bars-dim", "bright bars with edges 4.5 px apart, daylight only", ceiling=T_BAR, render=_DIM),
        make("t-bars-dim-tilt", "the same, tilt up to 2 deg", ceiling=T_BAR, render=_DIM, tilt=TWO_DEG),
        make("bare", "plaster with lamps only", ceiling=PLASTER, bars={**never_wrong, **FEW_LINES}),
        make(
            "walls",
            "walls with doors and a rail, seen below the ceiling",
            lap=replace(LAP, room_m=6.54, inset_m=0.8),
            surroundings=SurroundingsSpec(walls=True),
            bars=never_wrong,
        ),
    ]


def _heights() -> list[Condition]:
    """Ceilings of more than one height; recall and precision count what hangs at the calibrated one."""
    bars = {"drift_pct": at_most(0.1), "worst_mm": at_most(20.0), "wrong": at_most(0.0), "tracking_pct": at_least(90.0)}
    high_m = simulated_calibration().ceiling_height_m
    steep = float(np.tan(np.radians(5.0)))
    slopes = {"slope": ((steep, 0.0), "along x"), "slope-across": ((0.0, steep), "along y")}
    rooms = [(n.replace("_", "-"), a, getattr(scenes, n)(LAP.room_m, high_m)) for n, a in HANGING.items()]
    found_out = [
        *(make(name, a, surroundings=room, bars=bars) for name, a, room in rooms),
        *(
            make(name, f"the ceiling rises by 5 deg {where}", ceiling=CeilingSpec(slope=rise), bars=bars)
            for name, (rise, where) in slopes.items()
        ),
    ]
    known = (
        replace(c, name=c.name + KNOWN, about=f"{c.about}; known from a lap before", known=True) for c in found_out
    )
    return [*found_out, *known]


def _fainter(levels: float) -> Condition:
    """Joints that are so many grey levels deep, between tiles all alike, beside lamps that saturate."""
    bars = {"recall_grid_pct": at_least(85.0), "precision_pct": at_least(97.0)} if levels >= 3.0 else {}
    return make(f"faint-{levels:g}", f"grooves {levels:g} grey levels deep", ceiling=_darker(levels), bars=bars)


def _darker(levels: float) -> CeilingSpec:
    return CeilingSpec(groove_darker=_DARKER_A_LEVEL * levels, tile_spread=0.0)


def _in_the_way() -> list[Condition]:
    return [
        make("occluded", "plates 1.5 m above the camera pass by", surroundings=OVERHANG),
        make("occluded-fixed", "a plate on the robot hides 25 % of the view", surroundings=ON_ROBOT),
    ]


def _driving() -> list[Condition]:
    bars = {"motion_median_mm": at_most(0.5), "motion_p95_mm": at_most(1.8), "worst_mm": at_most(15.0)}
    fast = replace(LAP, speed_mps=0.8, corner_radius_m=0.8 / np.radians(90.0))
    return [
        make("tilt", "tilt up to 2 deg with vibration", tilt=TWO_DEG, bars={**bars, **TIMES}),
        make(
            "tilt-start",
            "the same from the first frame on, while the robot still stands",
            tilt=replace(TWO_DEG, at_rest=True),
            bars={**bars, "tracking_worst_mm": Bar("<=", 8.0)},
        ),
        make("tilt-full", "the same, looked at whole", tilt=TWO_DEG, overrides=FULL, bars={**bars, **WHOLE_TIMES}),
        make("fast", "0.8 m/s, turns of 90 deg/s", lap=fast),
        make("turning", "1 m/s, turns of 1.5 rad/s", lap=TURNING),
        make("rolling-20ms", "the same, rows read in 20 ms", lap=TURNING, true=ROLLING),
        make("5-fps", "5 frames a second", fps=5.0),
        make("blackout", "1 s without light on a straight", blackouts=(0.33,)),
        make("blackout-bend", "1 s without light in a bend", blackouts=(0.213,)),
    ]


def _calibration() -> list[Condition]:
    return [
        make("cal-k1", "k1 5 % too large", assumed=misjudged(k1=1.05)),
        make("cal-f", "f 0.5 % too long", assumed=misjudged(f=1.005)),
        make("cal-centre", "principal point off by 2 px in x and y", assumed=misjudged(centre_px=2.0)),
        make("cal-all", "all three", assumed=misjudged(1.05, 1.005, 2.0)),
    ]


def _lenses() -> list[Condition]:
    found = {"recall_grid_pct": at_least(97.0)}
    sizes = ((320, 240), (323, 243), (641, 479), (644, 482), (1280, 960), (1920, 1080))
    return [
        *(make(f"{w}x{h}", "base, pictures of another size", true=_of_size(w, h), bars=found) for w, h in sizes),
        make("1280x720", "larger picture", true=_of_size(1280, 720)),
        make("160x120", "base, the smallest picture", true=_of_size(160, 120)),
        make("fisheye", "fisheye lens", true=simulated_calibration(simulated_camera("fisheye"))),
        make(
            "fisheye-22-faint-3",
            "fisheye lens 22 deg off the vertical, grooves 3 grey levels deep",
            ceiling=_darker(3.0),
            true=simulated_calibration(simulated_camera("fisheye"), pitch_rad=float(np.radians(22.0))),
        ),
    ]


def _of_size(width_px: int, height_px: int) -> Calibration:
    return simulated_calibration(simulated_camera("pinhole", width_px, height_px))


def _stress() -> list[Condition]:
    render = replace(noisy(3.0), flicker_depth=0.3, switch_groups=3, switch_period_s=1.7)
    about = "noise x3, flicker, switching, tilt 2 deg, plates pass by"
    stress: dict[str, Any] = {"render": render, "tilt": TWO_DEG, "surroundings": OVERHANG}
    return [
        make("mixed", about, **stress, bars={"restarts": at_most(0.0), "drift_pct": at_most(0.1)}),
        make(
            "mixed-cal",
            about + ", calibration errors",
            **stress,
            assumed=misjudged(1.05, 1.005, 2.0),
            bars={"restarts": at_most(0.0), "drift_pct": at_most(0.5)},
        ),
    ]


def _found_ceilings() -> list[Condition]:
    """What is found in buildings: right, or said not to be."""
    few_points = ("wood-slats", "slats-round", "plaster-round", "plaster-glints", "strips-only")
    few_lines, not_always_seen = (*few_points, "hexagons", "hexagons-round", "two-lamps"), ("boards", *few_points)
    return [
        make(
            f.name,
            f.about,
            ceiling=f.ceiling,
            render=f.render,
            true=f.true,
            bars={
                **({} if f.name in not_always_seen else {"worst_mm": at_most(20.0)}),
                **(FEW_LINES if f.name in few_lines else {}),
            },
        )
        for f in found_ceilings()
    ]


def misjudged(k1: float = 1.0, f: float = 1.0, centre_px: float = 0.0) -> Calibration:
    """The simulated camera as a poor commissioning would describe it: factors of k1 and f, shift of the centre."""
    true = simulated_calibration()
    cam = true.camera
    wrong = CameraModel(
        kind=cam.kind,
        width_px=cam.width_px,
        height_px=cam.height_px,
        fx_px=cam.fx_px * f,
        fy_px=cam.fy_px * f,
        cx_px=cam.cx_px + centre_px,
        cy_px=cam.cy_px + centre_px,
        distortion=(cam.distortion[0] * k1, *cam.distortion[1:]),
    )
    mount = float(true.mount_xy_m[0]), float(true.mount_xy_m[1])
    projection = projection_matrix(wrong, true.camera_from_base, mount, true.ceiling_height_m)
    return replace(true, camera=wrong, projection=projection)


def _found(recall_pct: float) -> dict[str, Bar]:
    return {"recall_pct": at_least(recall_pct), "precision_pct": at_least(98.0)}


def noisy(times: float, usual: RenderSpec = USUAL) -> RenderSpec:
    """So many times the noise."""
    return replace(usual, read_noise=usual.read_noise * times, shot_noise=usual.shot_noise * times**2)


def _overhang() -> SurroundingsSpec:
    """Plates along the path, each wider than a quarter of the view, none parallel to the ceiling's grid."""
    path = LapPath(LAP)
    slabs = []
    for k, travel in enumerate(np.arange(1.5, path.lap_m, 1.7)):
        t = travel / LAP.speed_mps + LAP.rest_s + 0.5 * LAP.ramp_s
        x, y, theta = path.pose_at(t)
        side = 0.35 if k % 2 else -0.35
        at = (float(x - side * np.sin(theta)), float(y + side * np.cos(theta)))
        slabs.append(Slab(at, (1.1, 0.85), float(theta + (0.2, -0.3, 0.45)[k % 3]), 1.5))
    return SurroundingsSpec(slabs=tuple(slabs))


_DIM = replace(USUAL, lit=())
OVERHANG = _overhang()
ON_ROBOT = SurroundingsSpec(slabs=(Slab((MOUNT_XY_M[0], 0.17), (0.9, 0.19), 0.0, 0.5, 0.1, "base"),))
"""m, rad; chosen: the plate hides 25 % of the view (occluded-fixed)."""
