"""What the noise of a frame is measured on."""

import numpy as np

from ceilvo.config import Features
from ceilvo.daemon.vision.edges import framed_room, noise_samples, smoothed, thresholds
from ceilvo.sim.rig import simulated_calibration, simulated_camera

SEED = 3


def test_clutter_at_the_rim_of_a_fisheye_does_not_raise_the_threshold() -> None:
    view = simulated_calibration(simulated_camera("fisheye")).level_view
    samples = noise_samples(view, 70.0)
    rng = np.random.default_rng(SEED)
    clean = np.clip(np.rint(rng.normal(120.0, 2.0, (480, 640))), 0, 255).astype(np.uint8)
    rim = ~np.isfinite(view.lookup(56.0)[:480, :640, 0])
    cluttered = np.where(rim, rng.integers(0, 256, clean.shape), clean).astype(np.uint8)
    (*_, of_clean), (*_, of_cluttered) = (
        thresholds(smoothed(gray, Features(), framed_room(view)), Features(), samples) for gray in (clean, cluttered)
    )
    print(f"seed {SEED}: {rim.mean():.2f} of the picture is rim; thresholds {of_clean:.1f} and {of_cluttered:.1f}")
    assert rim.mean() > 0.1
    assert of_cluttered == of_clean


def test_a_usual_camera_sees_nothing_but_ceiling_and_all_of_an_even_raster_counts() -> None:
    view = simulated_calibration().level_view
    at = noise_samples(view, 70.0)
    raster = np.arange(480 * 640).reshape(480, 640)[::11, ::11]
    assert np.array_equal(at, raster.reshape(-1))


def test_a_camera_that_leans_out_of_the_ceiling_still_measures_its_noise() -> None:
    view = simulated_calibration().level_view
    assert len(noise_samples(view, 1.0)) == 44 * 59
