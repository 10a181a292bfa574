"""Recordings: what is written is what is read, and every way a recording can be wrong has its own line."""

from __future__ import annotations

import gzip
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import config
from ceilvo.drivers.camera.recorded import FolderCamera, VideoCamera, write_folder
from ceilvo.drivers.camera.selection import make_camera, source_camera
from ceilvo.drivers.camera.v4l2_camera import V4l2Camera
from ceilvo.drivers.ports import Camera
from ceilvo.errors import ConfigError, FileFormatError
from ceilvo.types import Frame

W, H = 32, 24
SEED = 7


def noise(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(SEED)
    return [rng.integers(0, 256, (H, W), dtype=np.uint8) for _ in range(count)]


def frames(stamps: list[int]) -> list[Frame]:
    return [Frame(i, s, g) for i, (s, g) in enumerate(zip(stamps, noise(len(stamps)), strict=True))]


def read_all(camera: Camera) -> list[Frame]:
    camera.open()
    out = []
    while (frame := camera.read()) is not None:
        out.append(frame)
    camera.close()
    return out


def index(folder: Path, text: str) -> FolderCamera:
    cv2.imwrite(str(folder / "a.png"), np.zeros((H, W), np.uint8))
    cv2.imwrite(str(folder / "b.png"), np.full((H, W), 9, np.uint8))
    (folder / "frames.csv").write_text(text)
    return FolderCamera(folder)


# --- folder with an index


@given(
    stamps=st.lists(st.integers(0, 2**62), min_size=1, max_size=6, unique=True).map(sorted),
    image_format=st.sampled_from(["png", "pgm", "bmp"]),
)
@settings(max_examples=20, deadline=None)
def test_written_is_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, stamps: list[int], image_format: str
) -> None:
    folder = tmp_path_factory.mktemp("rec")
    written = frames(stamps)
    assert write_folder(folder, written, image_format) == len(stamps)
    got = read_all(FolderCamera(folder))
    assert [f.stamp_ns for f in got] == stamps
    assert [f.seq for f in got] == list(range(len(stamps)))
    assert all(np.array_equal(a.gray, b.gray) for a, b in zip(got, written, strict=True))


def test_rate_is_that_of_the_stamps(tmp_path: Path) -> None:
    write_folder(tmp_path, frames([10**9, 10**9 + 50_000_000, 10**9 + 100_000_000]))
    info = FolderCamera(tmp_path).open()
    assert abs(info.rate_hz - 20.0) < 1e-9
    assert info.notes == ()
    assert not info.live


def test_index_from_a_spreadsheet(tmp_path: Path) -> None:
    camera = index(tmp_path, '\ufefffile, stamp_ns, note\r\na.png, 5, "x, y"\r\nb.png, 7,\r\n')
    assert [(f.stamp_ns, int(f.gray[0, 0])) for f in read_all(camera)] == [(5, 0), (7, 9)]


def test_colour_images_become_grey(tmp_path: Path) -> None:
    colour = np.zeros((H, W, 3), np.uint8)
    colour[...] = (255, 0, 0)
    cv2.imwrite(str(tmp_path / "a.png"), colour)
    (tmp_path / "frames.csv").write_text("stamp_ns,file\n1,a.png\n")
    gray = read_all(FolderCamera(tmp_path))[0].gray
    assert abs(int(gray[0, 0]) - 0.114 * 255) <= 1  # BT.601 weight of blue


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r"frames.csv: column 'stamp_ns' is missing, found nothing"),
        ("time,file\n1,a.png\n", r"frames.csv: column 'stamp_ns' is missing, found \['time', 'file'\]"),
        ("stamp_ns,name\n1,a.png\n", r"frames.csv: column 'file' is missing"),
        ("stamp_ns,file\n1,a.png\n2,c.png\n", r"frames.csv line 3: file 'c.png' does not exist"),
        (f"stamp_ns,file\n{'9' * 5000},a.png\n", r"line 2: stamp_ns '9+\.\.\.9+', expected whole nanoseconds below"),
        (f"stamp_ns,file\n{10**400},a.png\n", r"line 2: stamp_ns '10+\.\.\.0+', expected"),
        (f"stamp_ns,file\n1,{'n' * 300}\n", r"line 2: file 'n+\.\.\.n+' does not exist"),
        (
            f"stamp_ns,file\n1,{'n' * 200_000}\n",
            r"frames.csv line 2: field larger than field limit .*; expected a stamp",
        ),
        (f"stamp_ns,{'n' * 200_000}\n", r"frames.csv line 1: field larger than field limit"),
        (f"stamp_ns,{'n' * 2000}\n1,a.png\n", r"column 'file' is missing, found \['stamp_ns', 'n+\.\.\.n+'\]"),
        ("stamp_ns,file\n1,a\0.png\n", r"frames.csv line 2"),
        ("stamp_ns,file\n1,a.png\n2\n", r"frames.csv line 3: file None does not exist"),
        ("stamp_ns,file\n1,\n", r"frames.csv line 2: file '' does not exist"),
        ("stamp_ns,file\n0.5,a.png\n", r"frames.csv line 2: stamp_ns '0.5', expected whole nanoseconds"),
        ("stamp_ns,file\n-5,a.png\n", r"frames.csv line 2: stamp_ns '-5'"),
        ("stamp_ns,file\n5,a.png\n5,b.png\n", r"frames.csv line 3: stamp_ns 5 is not after the one before, 5"),
        ("stamp_ns,file\n5,a.png\n4,b.png\n", r"frames.csv line 3: stamp_ns 4 is not after the one before, 5"),
        ("stamp_ns,file\n", r": no frame in it"),
    ],
)
def test_index_mistakes_are_found_at_open(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError, match=says) as caught:
        index(tmp_path, text).open()
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_index_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(FileFormatError, match=r"frames.csv: cannot be read"):
        FolderCamera(tmp_path).open()


@pytest.mark.parametrize("content", [b"", b"no image at all"])
def test_unreadable_image_names_file_and_row(tmp_path: Path, content: bytes) -> None:
    camera = index(tmp_path, "stamp_ns,file\n1,a.png\n2,b.png\n")
    (tmp_path / "b.png").write_bytes(content)
    camera.open()
    assert camera.read() is not None
    with pytest.raises(FileFormatError, match=r"frames.csv line 3: b.png is no image"):
        camera.read()


def test_another_size_names_the_row(tmp_path: Path) -> None:
    camera = index(tmp_path, "stamp_ns,file\n1,a.png\n2,b.png\n")
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((H, W + 1), np.uint8))
    camera.open()
    camera.read()
    with pytest.raises(FileFormatError, match=r"line 3: image of 33x24, expected 32x24 like the first"):
        camera.read()


# --- folder without an index


def test_plain_images_come_in_order_of_name_at_the_nominal_rate(tmp_path: Path) -> None:
    for name, value in (("b.png", 2), ("a.jpg", 1), ("c.PGM", 3)):
        (tmp_path / name).write_bytes(cv2.imencode(Path(name).suffix.lower(), np.full((H, W), value, np.uint8))[1])
    (tmp_path / "notes.txt").write_text("not an image")
    camera = FolderCamera(tmp_path, rate_hz=20.0)
    info = camera.open()
    assert info.rate_hz == 20.0
    assert len(info.notes) == 1
    assert "stamps assume 20 frames per second" in info.notes[0]
    assert [(f.stamp_ns, int(f.gray[0, 0])) for f in read_all(camera)] == [
        (50_000_000, 1),
        (100_000_000, 2),
        (150_000_000, 3),
    ]


def test_nothing_to_read(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"neither frames.csv nor"):
        FolderCamera(tmp_path).open()
    with pytest.raises(FileFormatError, match="no such folder"):
        FolderCamera(tmp_path / "absent").open()


# --- raw frames


def raw(folder: Path, images: list[np.ndarray], name: str = "f.raw.gz") -> Path:
    path = folder / name
    path.write_bytes(gzip.compress(b"".join(i.tobytes() for i in images)))
    return path


def test_raw_frames_of_several_files(tmp_path: Path) -> None:
    images = noise(5)
    raw(tmp_path, images[3:], "b.raw.gz")
    raw(tmp_path, images[:3], "a.raw.gz")
    got = read_all(FolderCamera(tmp_path, width_px=W, height_px=H, rate_hz=10.0))
    assert [f.stamp_ns for f in got] == [100_000_000 * (i + 1) for i in range(5)]
    assert all(np.array_equal(a.gray, b) for a, b in zip(got, images, strict=True))


def test_raw_frames_need_their_size(tmp_path: Path) -> None:
    raw(tmp_path, noise(1))
    with pytest.raises(FileFormatError, match="need width_px and height_px"):
        FolderCamera(tmp_path).open()


def test_raw_frames_of_another_size_or_cut_short(tmp_path: Path) -> None:
    raw(tmp_path, noise(2))
    camera = FolderCamera(tmp_path, width_px=W, height_px=H + 1)
    camera.open()
    camera.read()
    with pytest.raises(FileFormatError, match=r"f.raw.gz: frame 1 has 736 bytes, expected 800 \(32x25\)"):
        camera.read()


@pytest.mark.parametrize("damage", ["cut", "flip", "not gzip"])
def test_damaged_raw_file(tmp_path: Path, damage: str) -> None:
    path = raw(tmp_path, noise(3))
    data = bytearray(path.read_bytes())
    if damage == "cut":
        del data[-100:]
    elif damage == "flip":
        data[-6] ^= 0xFF  # in the checksum
    else:
        data[:2] = b"no"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"f.raw.gz: (frame \d: damaged|frame \d has)"):
        read_all(FolderCamera(tmp_path, width_px=W, height_px=H))


# --- video


def video(path: Path, count: int, fps: float = 25.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), fps, (W, H))
    for i in range(count):
        writer.write(np.full((H, W, 3), 20 * i, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("suffix", ["avi", "mkv"])
def test_video_frames_and_times(tmp_path: Path, suffix: str) -> None:
    camera = VideoCamera(video(tmp_path / f"v.{suffix}", 10))
    info = camera.open()
    assert (info.width_px, info.height_px, info.rate_hz, info.live) == (W, H, 25.0, False)
    got = read_all(camera)
    assert [round(float(f.gray.mean())) for f in got] == [20 * i for i in range(10)]
    assert all(abs(f.stamp_ns - 40_000_000 * (i + 1)) <= 1_000_000 for i, f in enumerate(got))


def test_video_without_times_counts_periods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Timeless:
        def __init__(self, *_: object) -> None:
            self.left = 4

        def isOpened(self) -> bool:
            return True

        def get(self, prop: int) -> float:
            return 0.0

        def read(self) -> tuple[bool, np.ndarray | None]:
            self.left -= 1
            return (True, np.zeros((H, W, 3), np.uint8)) if self.left >= 0 else (False, None)

        def release(self) -> None:
            pass

    (tmp_path / "v.avi").write_bytes(b"x")
    monkeypatch.setattr(cv2, "VideoCapture", Timeless)
    camera = VideoCamera(tmp_path / "v.avi", rate_hz=50.0)
    assert "tells no rate: 50 assumed" in camera.open().notes[0]
    assert [f.stamp_ns for f in read_all(camera)] == [20_000_000 * (i + 1) for i in range(4)]


def test_no_video(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"this is no video")
    with pytest.raises(FileFormatError, match=r"v.mp4: no video that OpenCV can read"):
        VideoCamera(tmp_path / "v.mp4").open()
    with pytest.raises(FileFormatError, match="no such video file"):
        VideoCamera(tmp_path / "w.mp4").open()


# --- writing


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    write_folder(tmp_path, frames([1]))
    with pytest.raises(FileFormatError, match=r"frames.csv exists"):
        write_folder(tmp_path, frames([2]))
    assert [f.stamp_ns for f in read_all(FolderCamera(tmp_path))] == [1]


def test_an_interrupted_recording_has_no_index(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="frame 2: stamp 20 ns is not after 20 ns"):
        write_folder(tmp_path, frames([10, 20]) + frames([20]))
    assert not (tmp_path / "frames.csv").exists()


def test_unknown_image_format(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="image format 'doc'"):
        write_folder(tmp_path / "new", frames([1]), "doc")
    assert not (tmp_path / "new").exists()


# --- which camera


def test_source_camera_looks(tmp_path: Path) -> None:
    write_folder(tmp_path / "f", frames([1, 2]))
    assert isinstance(source_camera(tmp_path / "f"), FolderCamera)
    assert isinstance(source_camera(str(video(tmp_path / "v.avi", 2))), VideoCamera)
    with pytest.raises(FileFormatError, match="no such folder or video file"):
        source_camera(tmp_path / "absent")
    with pytest.raises(FileFormatError, match=r"name the folder that it is in, .*/f$"):
        source_camera(tmp_path / "f" / "frames.csv")


def test_source_camera_hands_sizes_and_rate_on(tmp_path: Path) -> None:
    raw(tmp_path, noise(2))
    info = source_camera(tmp_path, W, H, 5.0).open()
    assert (info.width_px, info.height_px, info.rate_hz) == (W, H, 5.0)


def test_make_camera_follows_the_configuration(tmp_path: Path) -> None:
    assert isinstance(make_camera(config.Camera()), V4l2Camera)
    raw(tmp_path, noise(2))
    made = make_camera(config.Camera(source="folder", path=str(tmp_path), width_px=W, height_px=H, rate_hz=5.0))
    assert (made.open().width_px, made.open().rate_hz) == (W, 5.0)
    assert isinstance(make_camera(config.Camera(source="video", path="v.mp4")), VideoCamera)
    with pytest.raises(ConfigError, match=r"camera.path: empty, but camera.source is 'folder'"):
        make_camera(config.Camera(source="folder"))
