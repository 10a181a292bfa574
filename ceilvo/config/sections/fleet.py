"""Keys of config.yaml for maps that a fleet shares; see ceilvo.config.schema."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.config.sections.keys import key


@dataclass(frozen=True)
class Fleet:
    service: str = key(
        "", "name of the building at its map service (ceilvod mapd); empty = no fleet, nothing is fetched"
    )
    floor: str = key("", "which of the building's maps")
    key_file: str = key("", "this robot's private key, made by ceilvod map key; empty = fetch only, offer nothing")
    period_s: float = key(600.0, "period of fetching and of offering", low=1.0, high=86400.0)
    waiting_bytes: int = key(
        20_000_000,
        "offers that wait on disk while the service is away; what is learnt then is offered later",
        low=100_000,
        high=10**12,
    )


@dataclass(frozen=True)
class Mapd:
    """Of `ceilvod mapd`."""

    building: str = key("building", "what robots call it in fleet.service")
    policy: str = key(
        "approve",
        "approve = a person looks at every offer; quorum = robots that agree; trusted = trusted keys only. What a "
        "trusted key signed is taken in any case, if it fits the map",
        choices=("approve", "quorum", "trusted"),
    )
    quorum: int = key(3, "robots that must agree on a landmark within their sigmas", low=1, high=100)
    tile_m: int = key(8, "side of the square tiles that robots fetch", low=2, high=64)
    merge_period_s: float = key(60.0, "period of a new version, where there is anything new", low=0.05, high=86400.0)
    offers_per_hour: float = key(120.0, "of each robot, after a burst of 20", low=1.0, high=1e6)
