"""Draws docs/images/pipeline.jpg: .venv/bin/python docs/images/pipeline.py"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.drawing.overlay import draw_overlay, draw_particles_panel, previous_pixels
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec

FPS, SECONDS, ZOOM_M = 10.0, 8.1, 0.03
FILE = Path(__file__).with_name("pipeline.jpg")


def main() -> int:
    world = World(WorldSpec(seed=1))
    config = Config()
    pipeline = Pipeline(world.calibration, config, np.random.default_rng(config.service.seed))
    pipeline.set_pose(world.initial_pose, np.diag([1e-6, 1e-6, 1e-6]), "where the simulated robot starts")
    camera = SimCamera(world, FPS, realtime=False, duration_s=SECONDS)
    camera.open()
    estimates = []
    while (frame := camera.read()) is not None:
        estimates.append(pipeline.step(frame))
    camera.close()

    view, last = pipeline.vision.view, estimates[-1]
    before = previous_pixels(view.crossings, last.motion, world.calibration)
    left = draw_overlay(view.frame.gray, view.lines, view.crossings, world.calibration.level_view, before, scale=2)
    size = left.shape[0] // 2
    path = np.array([e.pose[:2] for e in estimates])
    particles, weights = pipeline.filter.particles()
    marks, none = pipeline.filter.landmarks(), (np.zeros((0, 2)), None)
    x, y = last.pose[:2]
    near = (x - ZOOM_M / 2, y - ZOOM_M / 2, x + ZOOM_M / 2, y + ZOOM_M / 2)
    room = draw_particles_panel(particles, weights, marks.xy_map_m, marks.cov_m2, last.pose, path, size_px=size)
    cloud = draw_particles_panel(particles, weights, *none, last.pose, path, None, near, size_px=size)
    cv2.line(cloud, (0, 0), (size, 0), (120, 120, 120), 1)
    picture = np.hstack([left, np.vstack([room, cloud])])
    return 0 if cv2.imwrite(str(FILE), picture, [cv2.IMWRITE_JPEG_QUALITY, 82]) else 1


if __name__ == "__main__":
    sys.exit(main())
