"""The robot's maps as a fleet manager may change them: brought to the shelf, chosen for the next start, removed."""

from __future__ import annotations

from collections.abc import Sequence

from ceilvo.config import Config
from ceilvo.daemon.map.kept.store import state_folder
from ceilvo.daemon.shelf.downloads import download
from ceilvo.daemon.shelf.shelf import Name, Shelf
from ceilvo.daemon.shelf.taking import InUse, in_use
from ceilvo.drivers.vda5050.maps import KnownMap
from ceilvo.errors import CeilvoError


class FleetMaps:
    """A vda5050.maps.Maps."""

    def __init__(self, config: Config) -> None:
        self._config, self._state_dir = config, state_folder(config.service.state_dir)

    def known(self) -> Sequence[KnownMap]:
        used = self._in_use()
        shelved = () if self._state_dir is None else Shelf(self._state_dir).names()
        return [
            KnownMap(*used.name, True, used.floor),
            *(KnownMap(floor, "", True, floor) for floor in used.others),
            *(KnownMap(*n, False) for n in shelved if n != used.name),
        ]

    def download(self, map_id: str, version: str, link: str, sha256: str) -> str:
        shelf, name = self._shelf(), Name(map_id, version)
        if self._is_used(name) or name in shelf.names():
            raise CeilvoError(f"{name}: is here already, expected another mapVersion")
        content = download(link, self._config.vda5050.map_sources, sha256)
        count, most = len(content.landmarks), self._config.filter.max_landmarks
        if not 0 < count <= most:
            raise CeilvoError(f"{name}: found {count} landmarks, expected 1 to filter.max_landmarks {most}")
        shelf.put(name, content)
        return f"{count} landmarks"

    def enable(self, map_id: str, version: str) -> str:
        name = Name(map_id, version)
        if self._is_used(name):
            return ""
        self._shelf().want(name)
        return f"the next start of the daemon takes {name}; until then {self._in_use().name} is in use"

    def settled(self, map_id: str, version: str) -> str | None:
        choice, name = self._shelf().choice(), Name(map_id, version)
        if choice.next == name:
            return None
        if self._is_used(name):
            return f"{name} is in use"
        raise CeilvoError(choice.refused or f"{name}: not taken, another map was chosen meanwhile: {choice.next}")

    def delete(self, map_id: str, version: str) -> str:
        name = Name(map_id, version)
        if self._is_used(name):
            raise CeilvoError(f"{name}: is in use, expected another one; enable another first")
        self._shelf().remove(name)
        return f"{name} is removed"

    def _is_used(self, name: Name) -> bool:
        return any(Name(m.id, m.version) == name for m in self.known() if m.enabled)

    def _in_use(self) -> InUse:
        own, floor = self._config.vda5050.map_id, self._config.service.floor
        if self._state_dir is None:
            return InUse(Name(floor or own, ""), floor)
        return in_use(self._state_dir, Shelf(self._state_dir).choice(), floor, own)

    def _shelf(self) -> Shelf:
        if self._state_dir is None:
            raise CeilvoError(
                "service.state_dir: found nothing, expected the folder where the daemon keeps its map; name it"
            )
        return Shelf(self._state_dir)
