"""One version of ceilvo in a process of its own, for frame_cost.py: a frame whenever it is told, and what it took.

It is run as a file by its path, so that an older version without it can be asked too; `PYTHONPATH` says which.
"""

import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.config.reader import replace
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.types import Frame


def main(folder: Path, overrides: list[str]) -> None:
    """A line of standard input is the number of a frame in FOLDER; a line of output its times, pose and state."""
    cv2.setNumThreads(1)
    frames, stamps = np.load(folder / "frames.npy", mmap_mode="r"), np.load(folder / "stamps.npy")
    config = replace(Config(), tuple(overrides))
    pipeline = Pipeline(read_calibration(folder / "calibration.yaml"), config, np.random.default_rng(1))
    for line in sys.stdin:
        k = int(line)
        gray = np.array(frames[k])
        spent_s: dict[str, float] = {}
        last_s = time.thread_time()

        def lap(stage: str, spent_s: dict[str, float] = spent_s) -> None:
            nonlocal last_s
            now_s = time.thread_time()
            spent_s[stage] = spent_s.get(stage, 0.0) + now_s - last_s
            last_s = now_s

        cv2.Canny(gray, 30, 70, L2gradient=True)
        lap("canny")
        estimate = pipeline.step(Frame(k, int(stamps[k]), gray), on_stage_done=lap)
        lap("rest")
        pose = [float(v) for v in estimate.pose]
        print(json.dumps({"s": spent_s, "pose": pose, "state": estimate.state.name}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
