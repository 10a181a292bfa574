"""All faults by their names."""

from __future__ import annotations

import numpy as np

from ceilvo.bench.place.ceiling.eye import Sight
from ceilvo.bench.place.ceiling.truth import Origin
from ceilvo.bench.place.faults import carried, changes, claims, pictures, signals
from ceilvo.bench.place.faults.script import Kind, Site
from ceilvo.bench.place.robot.drive import Drive


def _scaled(d: Drive, site: Site) -> tuple[Sight, float]:
    step_m = float(d.rng.choice([-0.4, 0.4]))
    return Sight(scale=2.2 / (2.2 + step_m)), float(d.rng.uniform(10.0, 45.0))


def _bumped(d: Drive, site: Site) -> tuple[Sight, float]:
    yaw = float(d.rng.choice([-1.0, 1.0]) * d.rng.uniform(5.5, 8.0))
    return Sight(yaw_rad=float(np.radians(yaw))), 20.0


def _dirty(d: Drive, site: Site) -> tuple[Sight, float]:
    return Sight(ghosts_m=d.rng.uniform(-1.0, 1.0, (4, 2))), 20.0


def _ramp(d: Drive, site: Site) -> tuple[Sight, float]:
    tilt = float(d.rng.uniform(1.0, 3.0))
    way = d.rng.uniform(-np.pi, np.pi)
    shift = 2.2 * np.tan(np.radians(tilt)) * np.array([np.cos(way), np.sin(way)])
    return Sight(shift_m=(float(shift[0]), float(shift[1]))), 5.0


KINDS: dict[str, Kind] = {
    "carried 1 tile dark": Kind(carried.carried_tiles((1,), True)),
    "carried 2 tiles dark": Kind(carried.carried_tiles((2,), True)),
    "carried 5 tiles dark": Kind(carried.carried_tiles((5,), True)),
    "carried 8 tiles dark": Kind(carried.carried_tiles((8,), True)),
    "carried 1 to 5 tiles light": Kind(carried.carried_tiles((1, 2, 5), False)),
    "snatched": Kind(carried.snatched),
    "pushed": Kind(carried.pushed),
    "carried anywhere dark": Kind(carried.anywhere(True)),
    "carried anywhere light": Kind(carried.anywhere(False)),
    "turned 90 deg": Kind(carried.turned_quarter),
    "spun in the dark": Kind(carried.spun_dark),
    "towed in the dark": Kind(carried.towed),
    "wheels in the air": Kind(carried.wheels_in_the_air, wheels=(True,)),
    "ring of 2": Kind(pictures.ring(2), pictures=True),
    "ring of 4": Kind(pictures.ring(4), pictures=True),
    "frozen with noise": Kind(pictures.frozen, pictures=True),
    "every frame twice": Kind(pictures.twice, pictures=True),
    "pictures late": Kind(pictures.late, pictures=True),
    "mirrored": Kind(pictures.mirrored, pictures=True),
    "upside down": Kind(pictures.upside_down, pictures=True),
    "stale now and then": Kind(pictures.stale_now_and_then, pictures=True),
    "camera bumped": Kind(pictures.sight(_bumped), wheels=(True,), pictures=True),
    "ceiling step": Kind(pictures.sight(_scaled)),
    "lamps off": Kind(pictures.sight(lambda d, site: (Sight(blind=(int(Origin.LAMP),)), 30.0))),
    "half the lamps gone": Kind(changes.half_the_lamps),
    "dirty lens": Kind(pictures.sight(_dirty)),
    "ramp": Kind(pictures.sight(_ramp)),
    "faint": Kind(pictures.sight(lambda d, site: (Sight(recall=0.4), 10.0))),
    "people": Kind(pictures.people),
    "dark turning on a fresh map": Kind(signals.dark_turning, wheels=(False,), map="fresh"),
    "dark drive": Kind(signals.dark_drive, pictures=True),
    "blackouts": Kind(signals.blackouts, pictures=True),
    "silent while changing speed": Kind(signals.no_frames(True)),
    "gap while changing speed": Kind(signals.no_frames(False)),
    "half the frames": Kind(signals.dropped),
    "frames a second apart": Kind(signals.seconds_apart),
    "stamps behind": Kind(signals.stamps_behind),
    "stamps jump": Kind(signals.stamps_jump),
    "wheels backwards": Kind(signals.wheels_say(signals.scaled(-1.0, 1.0)), wheels=(True,)),
    "wheels turn flipped": Kind(signals.wheels_say(signals.scaled(1.0, -1.0)), wheels=(True,)),
    "wheels that count too much": Kind(signals.wheels_say(signals.scaled(1.06, 1.0), dark_s=3.0), wheels=(True,)),
    "wheels stuck": Kind(signals.wheels_say(signals.scaled(0.0, 0.0), dark_s=1.0), wheels=(True,)),
    "wheels late": Kind(signals.wheels_late, wheels=(True,)),
    "slip in yaw": Kind(signals.wheels_say(signals.turning(0.5), 2.0, 2.0), wheels=(True,)),
    "over-run": Kind(signals.wheels_say(signals.scaled(1.9, 1.0), 2.0, 2.0), wheels=(True,)),
    "loss": Kind(signals.wheels_say(signals.scaled(0.1, 1.0), 2.0, 2.0), wheels=(True,)),
    "reset with map kept": Kind(claims.reset_map_kept),
    "pose a tile off": Kind(claims.pose_a_tile_off),
    "restart here": Kind(carried.restart(False)),
    "restart elsewhere": Kind(carried.restart(True)),
    "a third renovated": Kind(changes.over_night(changes.SHARE)),
    "lamps rehung": Kind(changes.rehung()),
    "another building": Kind(changes.over_night(1.0)),
    "another height": Kind(changes.other_height),
    "other floor": Kind(changes.other_floor),
    "reset elsewhere": Kind(claims.told(claims.reset_to(claims.elsewhere)), pictures=True),
    "reset here": Kind(claims.told(claims.reset_to(claims.here))),
    "given a tile off 2 cm": Kind(claims.told(claims.given_a_tile_off(0.02))),
    "given a tile off 11 cm": Kind(claims.told(claims.given_a_tile_off(0.11)), pictures=True),
    "given a tile off 50 cm": Kind(claims.told(claims.given_a_tile_off(0.5))),
    "given turned": Kind(claims.told(claims.given_turned), pictures=True),
    "given right": Kind(claims.told(claims.given_right), pictures=True),
    "given again and again": Kind(claims.told_again(claims.given_a_tile_off(0.02))),
    "asked again and again": Kind(claims.told_again(claims.relocalise)),
    "given and restarted": Kind(claims.told_and_restarted(claims.given_a_tile_off(0.02))),
    "reset and restarted": Kind(claims.told_and_restarted(claims.reset_to(claims.elsewhere))),
    "configured elsewhere": Kind(claims.told(claims.started_at(claims.elsewhere))),
    "configured here": Kind(claims.told(claims.started_at(claims.here))),
    "moved over night": Kind(carried.restart(True, changes.NIGHT_S)),
}
CARRIED_KINDS = (
    "carried 1 tile dark",
    "carried 2 tiles dark",
    "carried 5 tiles dark",
    "carried 1 to 5 tiles light",
    "snatched",
)
"""Moved by hand onto tiles that look the same."""
