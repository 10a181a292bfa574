"""A floor as robots can fetch it now: it does not change, so that any thread may answer from it."""

from __future__ import annotations

from dataclasses import dataclass, field

from ceilvo.daemon.fleet.manifests import GONE, PAGE, Manifest, Page, Request
from ceilvo.daemon.fleet.parts import PART_BYTES, packed_part
from ceilvo.daemon.fleet.tiles import Place, hash_of

MOST_PARTS = 8
"""Answered at once: 400 KB; the rest is asked for again."""


@dataclass(frozen=True)
class Published:
    """
    Attributes:
        versions: of every tile that there was, when it last changed.
        tiles: by their hashes, those of the version before as well: whoever is fetching it gets it whole.
    """

    manifest: Manifest
    versions: dict[Place, int]
    tiles: dict[bytes, bytes]
    root: bytes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", self.manifest.root)

    def page(self, request: Request) -> Page:
        """What changed since the version that the asker has, or all of it where that is none of ours."""
        m, since = self.manifest, request.since
        if since > m.version or (since == m.version and request.root != self.root):
            since = 0
        changed = sorted(place for place, version in self.versions.items() if version > since)
        if not since:
            changed = [place for place in changed if place in m.hashes]
        some = changed[request.at : request.at + PAGE]
        entries = {place: m.hashes.get(place, GONE) for place in some}
        return Page(m, since, self.root, len(changed), min(request.at, len(changed)), entries)

    def parts(self, wanted: list[tuple[bytes, int]]) -> list[bytes]:
        """Messages with what is wanted, hashes and where to begin; of what is there no more nothing."""
        out: list[bytes] = []
        for name, at in wanted:
            data = self.tiles.get(name, b"")
            while at < len(data) and len(out) < MOST_PARTS:
                out.append(packed_part(name, len(data), at, data[at : at + PART_BYTES]))
                at += PART_BYTES
        return out


def next_published(
    before: Published | None, manifest: Manifest, tiles: dict[Place, bytes], versions: dict[Place, int]
) -> Published:
    """With the tiles of the version before."""
    by_hash = {} if before is None else {h: before.tiles[h] for h in before.manifest.hashes.values()}
    return Published(manifest, versions, by_hash | {hash_of(data): data for data in tiles.values()})
