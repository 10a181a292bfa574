"""A recording replayed at its own pace."""

import numpy as np

from ceilvo.drivers.camera.paced import PacedCamera
from ceilvo.drivers.ports import CameraInfo
from ceilvo.types import Frame


class Recorded:
    def __init__(self, stamps_ns: list[int]) -> None:
        self._stamps, self.closed = stamps_ns, False

    def open(self) -> CameraInfo:
        self._left = list(enumerate(self._stamps))
        return CameraInfo("recorded", "", 4, 4, 10.0, live=False)

    def read(self) -> Frame | None:
        if not self._left:
            return None
        seq, stamp = self._left.pop(0)
        return Frame(seq, stamp, np.zeros((4, 4), np.uint8))

    def close(self) -> None:
        self.closed = True


def test_distances_are_kept_and_the_first_frame_is_now() -> None:
    now, slept = [1_000_000_000_000], []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += round(1e9 * seconds)

    recorded = Recorded([5, 100_000_005, 400_000_005])
    camera = PacedCamera(recorded, lambda: now[0], sleep)
    for _ in range(2):  # again after a reopening
        assert not camera.open().live
        start, frames = now[0], []
        while (frame := camera.read()) is not None:
            assert now[0] >= frame.stamp_ns
            frames.append(frame.stamp_ns - start)
        assert frames == [0, 100_000_000, 400_000_000]
    assert np.allclose(slept, [0.1, 0.3, 0.1, 0.3])
    camera.close()
    assert recorded.closed
