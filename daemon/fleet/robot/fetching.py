"""The fleet's map brought to a robot's disk: what changed, tile by tile, from where it stopped."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.daemon.fleet.manifests import GONE, Manifest, Page, Request, advanced, unpacked_page
from ceilvo.daemon.fleet.parts import MOST_WANTED, packed_wanted, unpacked_part
from ceilvo.daemon.fleet.replies import GONE_AGAIN, MANIFEST, TILES
from ceilvo.daemon.fleet.robot.link import Link, RefusedError
from ceilvo.daemon.fleet.robot.store import HELD, NEXT, FleetStore
from ceilvo.daemon.fleet.tiles import MOST_TILE_BYTES, joined
from ceilvo.daemon.fleet.wire import WireError

_MOST_BAD = 20
"""Answers that are no good before a fetch gives up until the next time; chosen."""
_MOST_PAGES = 1100
"""Of a manifest, with what a new version costs meanwhile: MOST_TILES of them are 1000."""
_FRESH = 5
"""Manifests in one fetch: a service that merges meanwhile is not chased for ever; chosen."""


@dataclass(frozen=True)
class Fetched:
    """
    Attributes:
        version: that is here whole now.
        is_new: it was not before.
        tiles: that came.
        refused: tiles and messages that were not what they should be.
    """

    version: int
    is_new: bool
    tiles: int
    refused: int


def fetch(store: FleetStore, link: Link, floor: str) -> Fetched:
    """Bring the newest version here. What has come is kept whatever happens: the next call goes on.

    Raises:
        AwayError, RefusedError: by the service.
        WireError: what came is no map.
        FileFormatError: the store cannot be written.
    """
    held = store.manifest(HELD)
    held = held if held is not None and held.floor == floor else None
    tiles = refused = 0
    for _ in range(_FRESH):
        wanted = _manifest(link, floor, held)
        if held is not None and wanted.root == held.root and not store.missing(held):
            if wanted.version != held.version:
                store.complete(wanted)
            break
        store.set_manifest(NEXT, wanted)
        came, bad = _tiles(store, link, wanted)
        tiles, refused = tiles + came, refused + bad
        if store.missing(wanted):  # a newer version has other tiles
            continue
        joined(store.tiles(wanted), wanted.tile_m)
        store.complete(wanted)
        store.count(tiles_fetched=tiles, tiles_refused=refused)
        return Fetched(wanted.version, True, tiles, refused)
    else:
        store.count(tiles_fetched=tiles, tiles_refused=refused)
        raise WireError(f"floor {floor!r}: {len(store.missing(wanted))} tiles of version {wanted.version} did not come")
    return Fetched(wanted.version, False, tiles, refused)


def _manifest(link: Link, floor: str, held: Manifest | None) -> Manifest:
    """The newest one, by difference to what is held where that is possible."""
    if held is None:
        return advanced(None, _pages(link, Request(floor, 0, GONE)))
    try:
        return advanced(held, _pages(link, Request(floor, held.version, held.root)))
    except WireError:  # the service may have begun anew
        return advanced(None, _pages(link, Request(floor, 0, GONE)))


def _pages(link: Link, request: Request) -> list[Page]:
    """All of one version."""
    out: list[Page] = []
    for _ in range(_MOST_PAGES):
        at = sum(len(p.entries) for p in out)
        page = unpacked_page(link.ask(MANIFEST, Request(request.floor, request.since, request.root, at).packed())[0])
        if page.head.floor != request.floor or page.at != at:
            found = f"{page.head.floor!r} from {page.at}"
            raise WireError(f"manifest: is of floor {found} on, expected {request.floor!r} from {at} on")
        if out and page.root != out[0].root:  # a newer version meanwhile
            out = []
            continue
        out.append(page)
        if at + len(page.entries) >= page.total:
            return out
        if not page.entries:
            raise WireError(f"manifest: an empty page, {at} of {page.total} entries came")
    raise WireError(f"manifest: did not end within {_MOST_PAGES} pages")


def _tiles(store: FleetStore, link: Link, wanted: Manifest) -> tuple[int, int]:
    """Bring what is missing; how many tiles came whole and how much was refused. Ends where nothing more comes."""
    came = bad = 0
    while (missing := store.missing(wanted)) and bad < _MOST_BAD:
        ask = [(name, at) for name, (at, _) in sorted(missing.items())[:MOST_WANTED]]
        parts = []
        try:
            answers = link.ask(TILES, packed_wanted(wanted.floor, ask))
        except RefusedError as e:
            if e.refusal.why != GONE_AGAIN:
                raise
            break
        for answer in answers:
            try:
                part = unpacked_part(answer, MOST_TILE_BYTES)
            except WireError:
                bad += 1
                continue
            if part.name in missing:
                parts.append((part.name, part.size, part.at, part.data))
            else:
                bad += 1
        whole, refused = store.add_parts(parts)
        came, bad = came + whole, bad + refused
        if not parts:
            break
    return came, bad
