"""A robot that may be anywhere: every place that a view can be from is listed once, and one of them is found."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.tally import Tally
from ceilvo.daemon.relocalisation import relocaliser
from ceilvo.types import State

FEW = 8
"""Places of a view that are taken up where it does not tell all of them; every view of a raster has more."""
FAR_M = 60.0


def lost_in_a_hall(seed: int) -> Drive:
    """Under a raster of lamps with gaps, and where the stored pose says, it is not."""
    world = make_world(WorldSpec("20", 0.6, "raster", seed))
    rng = np.random.default_rng([seed, 11])
    drive = drive_in(world, rng, True, 10.0, False, 0.8)
    load_known(drive, world, rng, np.asarray(se2.compose(world.map_from_ceiling, drive.driver.start())))
    drive.tally = Tally()
    return drive


@pytest.mark.parametrize("seed", [31, 32])
def test_a_hall_whose_every_view_has_more_places_than_are_taken_up_is_no_reason_to_search_for_ever(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the first view that tells all its places leaves out, it speaks against."""
    monkeypatch.setattr(relocaliser, "MOST_FOUND", FEW)
    drive = lost_in_a_hall(seed)
    place = drive.pipeline.relocaliser.state
    whole = False
    while drive.tally.metres < FAR_M:
        estimate = drive.tick()
        whole |= place.searched
        none_wins = place.sure or place.pending is not None or not place.belief.led_by_another
        assert none_wins or place.searched or place.belief.cut, "what is not listed may be right until then"
        if estimate is not None and estimate.state is State.TRACKING:
            break
    assert whole and place.sure and not place.searched, f"seed {seed}: {drive.tally.reasons[-1]}"
    assert not drive.tally.wrong_s, f"seed {seed}"


def test_another_doubt_begins_to_list_anew() -> None:
    drive = lost_in_a_hall(34)
    place = drive.pipeline.relocaliser.state
    while not place.searched:
        drive.tick()
    drive.estimator.relocalise()
    drive.conditions.dark = True  # nothing is weighed yet
    drive.tick()
    assert not place.searched
