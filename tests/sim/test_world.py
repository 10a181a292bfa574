"""World, camera and recording: time, pacing, gaps, determinism, files that other programs can read."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calibration_file import read_calibration
from ceilvo.errors import CameraError, ConfigError, FileFormatError
from ceilvo.sim.camera import SYNTHETIC_T0_NS, SimCamera
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.record import main, record
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec

QUARTER = simulated_calibration(simulated_camera(width_px=160, height_px=120))
COARSE = CeilingSpec(texel_m=0.012)


def small(**kw: object) -> World:
    return World(WorldSpec(ceiling=COARSE, **kw), QUARTER)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def world() -> World:
    return small()


class FakeTime:
    """A clock that only sleeping, or the test, advances."""

    def __init__(self, now_ns: int = 777_000_000_123) -> None:
        self.now_ns = now_ns
        self.slept: list[float] = []

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9)


def live(world: World, rate_hz: float = 25.0, **kw: float) -> tuple[SimCamera, FakeTime]:
    fake = FakeTime()
    return SimCamera(world, rate_hz, clock=fake.clock, sleep=fake.sleep, **kw), fake


def test_the_world_starts_once_and_knows_its_time() -> None:
    w = small()
    assert w.seconds(5_000_000_000) == 0.0
    assert w.start(2_000_000_000) == 2_000_000_000
    assert w.start(9_000_000_000) == 2_000_000_000
    assert w.seconds(5_500_000_000) == 3.5
    np.testing.assert_array_equal(w.truth_at(0.0), w.initial_pose)
    np.testing.assert_array_equal(w.wheel_odometry_at(0.0), np.zeros(3))


def test_the_same_time_is_the_same_picture_and_seeds_differ() -> None:
    a, b, other = small(seed=4), small(seed=4), small(seed=5)
    b.frame_at(1.0)  # having looked before changes nothing
    np.testing.assert_array_equal(a.frame_at(3.7), b.frame_at(3.7))
    assert not np.array_equal(a.frame_at(3.7), other.frame_at(3.7))
    assert not np.array_equal(a.frame_at(0.1), a.frame_at(0.2)), "noise of two frames at rest is the same"


def test_the_camera_never_sees_beyond_the_ceiling() -> None:
    for inset in (0.4, 1.0):
        lap = LapSpec(inset_m=inset)
        spec = WorldSpec(
            lap=lap,
            ceiling=COARSE,
            tilt=TiltSpec(np.radians(2.0)),
            render=RenderSpec(beyond=1e3, read_noise=0.0, shot_noise=0.0, lit=()),
        )
        w = World(spec, QUARTER)
        for t in np.linspace(0.0, 36.0, 60):
            assert w.frame_at(t).max() < 200  # what is beyond would be white


def test_an_exposure_shows_the_motion_that_happens_during_it() -> None:
    still = RenderSpec(read_noise=0.0, shot_noise=0.0, lit=())
    blurred = RenderSpec(read_noise=0.0, shot_noise=0.0, lit=(), exposure_s=0.1, sub_poses=4)
    sharp, long = small(render=still), small(render=blurred)
    mean = np.mean([sharp.frame_at(5.0 + 0.1 * (i + 0.5) / 4).astype(float) for i in range(4)], axis=0)
    assert np.abs(long.frame_at(5.0) - mean).max() <= 1.0
    assert np.abs(sharp.frame_at(5.0) - mean).max() > 5.0


def test_tilt_reaches_the_picture() -> None:
    quiet = RenderSpec(read_noise=0.0, shot_noise=0.0)
    flat, rocking = small(render=quiet), small(render=quiet, tilt=TiltSpec(np.radians(2.0)))
    np.testing.assert_array_equal(flat.frame_at(0.2), rocking.frame_at(0.2))  # at rest
    assert np.abs(flat.frame_at(6.0).astype(int) - rocking.frame_at(6.0)).max() > 20
    assert np.abs(rocking.tilt_at(6.0)).max() > 0


def test_a_recording_is_complete_even_and_repeats_bit_for_bit(world: World) -> None:
    def run() -> list[tuple[int, int, bytes]]:
        camera = SimCamera(small(seed=9), 30.0, realtime=False, duration_s=0.5)
        assert camera.open().live is False
        frames = []
        while (f := camera.read()) is not None:
            frames.append((f.seq, f.stamp_ns, f.gray.tobytes()))
        assert camera.read() is None
        return frames

    first = run()
    assert [f[0] for f in first] == list(range(15))
    assert [f[1] for f in first] == [SYNTHETIC_T0_NS + round(i * 1e9 / 30.0) for i in range(15)]
    assert first == run()


def test_a_recording_starts_over_when_opened_again(world: World) -> None:
    camera = SimCamera(world, 10.0, realtime=False, duration_s=1.0)
    camera.open()
    first = [camera.read() for _ in range(3)]
    camera.close()
    camera.open()
    again = camera.read()
    assert again is not None and first[0] is not None
    assert (again.seq, again.stamp_ns) == (first[0].seq, first[0].stamp_ns)
    np.testing.assert_array_equal(again.gray, first[0].gray)


def test_a_live_camera_keeps_its_rate_and_stamps_the_exposure() -> None:
    w = small()
    camera, fake = live(w)
    start = fake.now_ns
    info = camera.open()
    assert info.live and (info.width_px, info.height_px, info.camera_id) == (160, 120, "ceilvo-sim")
    for i in range(6):
        frame = camera.read()
        assert frame is not None
        assert frame.seq == i
        assert frame.stamp_ns == start + i * 40_000_000
        assert fake.now_ns == frame.stamp_ns
        np.testing.assert_array_equal(frame.gray, w.frame_at(i * 0.04))
        fake.now_ns += 11_000_000  # the reader's own work
    assert abs(max(fake.slept) - 0.029) < 1e-6


def test_a_late_reader_misses_exposures_and_sees_the_gap() -> None:
    w = small()
    camera, fake = live(w)
    camera.open()
    first = camera.read()
    fake.now_ns += 130_000_000  # exposures 1, 2, 3 have begun; 3 is the newest
    late = camera.read()
    following = camera.read()
    assert first is not None and late is not None and following is not None
    assert [first.seq, late.seq, following.seq] == [0, 3, 4]
    assert late.stamp_ns - first.stamp_ns == 120_000_000
    np.testing.assert_array_equal(late.gray, w.frame_at(0.12))


def test_a_frame_comes_after_its_exposure() -> None:
    camera, fake = live(small(render=RenderSpec(exposure_s=0.02)))
    camera.open()
    for i in range(3):
        frame = camera.read()
        assert frame is not None and frame.seq == i
        assert fake.now_ns - frame.stamp_ns == 20_000_000


def test_seq_goes_on_counting_when_a_live_camera_is_reopened() -> None:
    camera, fake = live(small())
    camera.open()
    before = [camera.read() for _ in range(3)][-1]
    camera.close()
    camera.close()
    fake.now_ns += 1_015_000_000
    camera.open()
    after = camera.read()
    assert before is not None and after is not None
    assert after.seq == before.seq + 1
    assert after.stamp_ns >= before.stamp_ns + 1_000_000_000
    assert after.stamp_ns <= fake.now_ns


def test_a_live_camera_joins_a_world_that_has_started() -> None:
    w = small()
    camera, fake = live(w)
    w.start(fake.now_ns - 2_010_000_000)
    camera.open()
    frame = camera.read()
    assert frame is not None and frame.seq == 0
    assert abs(w.seconds(frame.stamp_ns) - 2.04) < 1e-9
    assert frame.stamp_ns <= fake.now_ns


def test_a_live_camera_with_a_duration_ends() -> None:
    camera, _ = live(small(), duration_s=0.2)
    camera.open()
    seen = [camera.read() for _ in range(6)]
    assert [f.seq for f in seen if f is not None] == [0, 1, 2, 3, 4]
    assert seen[-1] is None


def test_reading_a_camera_that_is_not_open_is_an_error(world: World) -> None:
    camera = SimCamera(world, realtime=False)
    with pytest.raises(CameraError, match="open"):
        camera.read()
    camera.open()
    camera.close()
    with pytest.raises(CameraError, match="open"):
        camera.read()
    with pytest.raises(ConfigError, match="rate_hz is 0"):
        SimCamera(world, 0.0)


def test_a_recorded_folder_holds_frames_truth_and_calibration(tmp_path: Path) -> None:
    w = small(seed=6)
    assert record(tmp_path / "run", w, seconds=3.0, fps=4.0) == 12
    with (tmp_path / "run" / "frames.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    truth = np.loadtxt(tmp_path / "run" / "truth.tum")
    assert len(rows) == len(truth) == 12
    assert list(rows[0]) == ["stamp_ns", "file"]
    for i, (row, line) in enumerate(zip(rows, truth, strict=True)):
        t = w.seconds(int(row["stamp_ns"]))
        assert abs(t - i / 4.0) < 1e-9
        assert abs(line[0] - int(row["stamp_ns"]) / 1e9) < 1e-9
        pose = w.truth_at(t)
        np.testing.assert_allclose(line[1:4], [*pose[:2], 0.0], atol=1e-8)
        assert abs(se2.wrap(2 * np.arctan2(line[6], line[7]) - pose[2])) < 1e-9
        image = cv2.imread(str(tmp_path / "run" / row["file"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, w.frame_at(t))
    stored = read_calibration(tmp_path / "run" / "calibration.yaml")
    np.testing.assert_allclose(stored.projection, QUARTER.projection, rtol=1e-12)
    assert stored.camera == QUARTER.camera


def test_the_recording_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "jpg"
    usual = ["--width-px", "160", "--height-px", "120", "--seconds", "0.4", "--fps", "5", "--format", "jpg"]
    assert main([str(out), *usual, "--seed", "3", "--tilt-deg", "1", "--lamps-off", "--lens", "fisheye"]) == 0
    assert sorted(p.name for p in out.iterdir()) == [
        "000000.jpg",
        "000001.jpg",
        "calibration.yaml",
        "frames.csv",
        "truth.tum",
    ]
    assert "2/2 frames" in capsys.readouterr().err
    assert main([str(out), *usual]) == FileFormatError.exit_code
    assert "expected a new or empty folder" in capsys.readouterr().err
    assert main([str(tmp_path / "no"), *usual, "--room-m", "2"]) == ConfigError.exit_code
    assert "corner_radius_m" in capsys.readouterr().err


def test_curves_of_the_rig_cover_its_view() -> None:
    cal = simulated_calibration()
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    rays = cal.camera.rays(corners)
    reach = 2.2 * np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]
    assert (reach > 2.0).all() and (reach < 2.75).all()
    np.testing.assert_allclose(cal.mount_xy_m, [0.05, -0.03], atol=1e-9)
    assert abs(cal.ceiling_height_m - 2.2) < 1e-9


@pytest.mark.parametrize("readout_s", [0.02, -0.02])
@pytest.mark.parametrize("tilt", [TiltSpec(), TiltSpec(0.03)])
def test_each_row_of_a_rolling_shutter_is_of_its_own_time(readout_s: float, tilt: TiltSpec) -> None:
    """Against whole pictures of a global shutter at the rows' times; the stamp is the middle row's."""
    lens = simulated_camera(width_px=160, height_px=120, readout_s=readout_s)
    drive = {"lap": LapSpec(speed_mps=1.0, corner_radius_m=1.0 / 1.5), "render": RenderSpec(read_noise=0, shot_noise=0)}
    still = small(**drive, tilt=tilt)
    rolling = World(WorldSpec(ceiling=COARSE, **drive, tilt=tilt), simulated_calibration(lens))  # type: ignore[arg-type]
    t_s = 3.1
    seen, at_once = rolling.frame_at(t_s).astype(int), still.frame_at(t_s).astype(int)
    for row in (0, 31, 60, 101, 119):
        late_s = (row - 59.5) * readout_s / 120
        expected = still.frame_at(t_s + late_s)[row]
        assert np.abs(seen[row] - expected).max() <= 2
    assert np.abs(seen[0] - at_once[0]).max() > 20, "or the test shows nothing"


def test_a_picture_is_there_when_its_last_row_is() -> None:
    time = FakeTime()
    lens = simulated_camera(width_px=160, height_px=120, readout_s=-0.02)
    world = World(WorldSpec(ceiling=COARSE), simulated_calibration(lens))
    camera = SimCamera(world, 10.0, clock=time.clock, sleep=time.sleep)
    camera.open()
    frame = camera.read()
    assert frame is not None
    assert time.now_ns - frame.stamp_ns == 10_000_000
