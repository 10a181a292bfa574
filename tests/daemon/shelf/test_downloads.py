"""Maps from files and from a real web server: only from where the owner said, whole, and of a map's size."""

from __future__ import annotations

import hashlib
import http.server
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from map_contents import landmarks

from ceilvo.daemon.editing.exchange import to_geojson, to_json
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.shelf import downloads
from ceilvo.daemon.shelf.downloads import download
from ceilvo.errors import CeilvoError

CONTENT = MapContent.of(landmarks(40), 0.25, 1000.0)
OTHERS = "secret of another folder"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """maps/ with a map in three forms, and a file beside it."""
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "hall.json").write_text(to_json(CONTENT))
    (folder / "hall.geojson").write_text(to_geojson(CONTENT))
    (folder / "bad.json").write_text("{}")
    with open_map(folder / "hall.db", create=True) as db:
        db.edit(CONTENT, "made")
    (tmp_path / "secret.json").write_text(OTHERS)
    return folder


class _Handler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/maps/moved.json":
            self.send_response(302)
            self.send_header("Location", "/secret.json")
            self.end_headers()
        elif self.path == "/maps/short.json":
            self.send_response(200)
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b"{")
        else:
            super().do_GET()

    def log_message(self, format: str, *args: object) -> None: ...


@pytest.fixture
def server(tmp_path: Path, files: Path) -> Iterator[str]:
    def handler(*args: object) -> _Handler:
        return _Handler(*args, directory=str(tmp_path))  # type: ignore[arg-type]

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:  # type: ignore[arg-type]
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{running.server_address[1]}"
        running.shutdown()
        thread.join()


@pytest.mark.parametrize("name", ["hall.json", "hall.db", "hall.geojson"])
def test_every_form_of_a_map_comes_from_both(files: Path, server: str, name: str) -> None:
    sha256 = hashlib.sha256((files / name).read_bytes()).hexdigest()
    for link, allowed in ((f"file://{files}/{name}", f"file://{files}"), (f"{server}/maps/{name}", f"{server}/maps/")):
        found = download(link, ["https://nowhere.example/", allowed], sha256.upper())
        assert found.landmarks.xy_map_m.tobytes() == CONTENT.landmarks.xy_map_m.tobytes()
    assert sorted(p.name for p in files.iterdir()) == ["bad.json", "hall.db", "hall.geojson", "hall.json"]


@pytest.mark.parametrize(
    ("link", "says"),
    [
        ("{s}/secret.json", "expected a link below vda5050.map_sources"),
        ("{s}/maps/../secret.json", "expected a link below"),
        ("{s}/maps/%2e%2e/secret.json", "expected a link below"),
        ("{s}/maps", "expected a link below"),
        ("{s}/mapsecret", "expected a link below"),
        ("http://me@{h}/maps/hall.json", "expected a link below"),
        ("https://{h}/maps/hall.json", "expected a link below"),
        ("file://{f}/hall.json", "expected a link below"),
        ("ftp://{h}/maps/hall.json", "expected a link below"),
        ("", "expected a link below"),
        ("http://[", "no address"),
        ("{s}/maps/none.json", "did not come: 404"),
        ("{s}/maps/moved.json", "did not come: 302"),
        ("{s}/maps/short.json", "damaged or cut short|did not come"),
        ("{s}/maps/bad.json", "bad.json: not a ceilvo-map file"),
    ],
)
def test_what_does_not_come(files: Path, server: str, link: str, says: str) -> None:
    given = link.format(s=server, h=server.removeprefix("http://"), f=files)
    with pytest.raises(CeilvoError, match=says) as caught:
        download(given, [f"{server}/maps/"])
    assert "\n" not in str(caught.value) and OTHERS not in str(caught.value)


def test_a_server_that_is_away() -> None:
    with pytest.raises(CeilvoError, match=r"http://127\.0\.0\.1:9/a: did not come: .*refused"):
        download("http://127.0.0.1:9/a", ["http://127.0.0.1:9/"])


def test_files_that_are_none(files: Path) -> None:
    os.mkfifo(files / "pipe")
    for name, says in (("none.json", "No such file"), ("pipe", "not a file"), ("", "not a file")):
        with pytest.raises(CeilvoError, match=says):
            download(f"file://{files}/{name}", [f"file://{files}"])
    with pytest.raises(CeilvoError, match=r"mapHash: found [0-9a-f]{16}\.\.\., expected abc: sha256 of"):
        download(f"file://{files}/hall.json", [f"file://{files}"], "abc")
    with pytest.raises(CeilvoError, match=r"vda5050\.map_sources: found nothing"):
        download(f"file://{files}/hall.json", [])


def test_what_is_too_large(files: Path, server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "MOST_BYTES", 100)
    for link, allowed in ((f"file://{files}/hall.json", f"file://{files}"), (f"{server}/maps/hall.json", server)):
        with pytest.raises(CeilvoError, match="found more than 100 bytes, expected a map"):
            download(link, [allowed])
