"""Makes what the virtual robot is fed with from a recording of the simulated camera.

prepare.py RECORDING SHARE: frames.gray (raw), truth.csv, calibration.yaml, config.yaml, robot.env.
"""

from __future__ import annotations

import csv
import math
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import yaml

RATE_HZ = 15.0
BAUD = 115200
ENDPOINT = "tcp/127.0.0.1:7447"
ROBOT = "virtual"


def read_truth(path: Path) -> np.ndarray:
    """(F, 3) x, y, theta of a TUM file."""
    t = np.loadtxt(path, ndmin=2)
    return np.column_stack([t[:, 1], t[:, 2], 2.0 * np.arctan2(t[:, 6], t[:, 7])])


def main() -> None:
    recording, share = Path(sys.argv[1]), Path(sys.argv[2])
    with (recording / "frames.csv").open() as f:
        names = [row["file"] for row in csv.DictReader(f)]
    truth = read_truth(recording / "truth.tum")
    if len(names) != len(truth):
        raise SystemExit(f"{recording}: {len(names)} frames, {len(truth)} true poses")
    height, width = 0, 0
    with (share / "frames.gray").open("wb") as raw:
        for name in names:
            gray = cv2.imread(str(recording / name), cv2.IMREAD_GRAYSCALE)
            height, width = gray.shape
            raw.write(gray.tobytes())
    np.savetxt(share / "truth.csv", truth, "%.9f", ",")
    shutil.copy(recording / "calibration.yaml", share)
    x, y, theta = (float(v) for v in truth[0])
    config = {
        "robot": {"name": ROBOT},
        "camera": {
            "device": "/dev/video0",
            "pixel_format": "YUYV",
            "width_px": width,
            "height_px": height,
            "rate_hz": RATE_HZ,
        },
        "filter": {
            "initial_pose_x_m": round(x, 4),
            "initial_pose_y_m": round(y, 4),
            "initial_pose_theta_deg": round(math.degrees(theta), 3),
        },
        # The serial lines of User-Mode-Linux know no parity; the simulated base does not know the recorded path.
        "base": {"port": "/dev/ttyS1", "baud": BAUD, "parity": "N", "use_wheels": False},
        "zenoh": {"listen": [ENDPOINT]},
    }
    camera_id = yaml.safe_load((recording / "calibration.yaml").read_text())["camera"]["id"]
    (share / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    env = {
        "CAMERA": camera_id,
        "WIDTH": width,
        "HEIGHT": height,
        "RATE": RATE_HZ,
        "ENDPOINT": ENDPOINT,
        "STEM": f"ceilvo/{ROBOT}",
    }
    (share / "robot.env").write_text("".join(f"{k}='{v}'\n" for k, v in env.items()))


if __name__ == "__main__":
    main()
