"""Keys of config.yaml for radio ranges, marks and lamps; see ceilvo.config.schema."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.config.sections.keys import key


@dataclass(frozen=True)
class Beacons:
    file: str = key("", "anchors, marks and lamps of known place, relative to this file's folder; empty = none")
    ranges: str = key(
        "off",
        "where ranges to anchors come from: serial = a DWM1001 or alike, zenoh = <prefix>/<robot>/ranges",
        choices=("off", "serial", "zenoh"),
    )
    port: str = key("/dev/ttyACM0", "serial device of the module; prefer the stable name under /dev/serial/by-id/")
    baud: int = key(115200, "line rate of the module", low=1200, high=4000000)
    protocol: str = key(
        "les",
        "what the module speaks: les or lec = lines of its shell, tlv = its binary interface, asked by dwm_loc_get",
        choices=("les", "lec", "tlv"),
    )
    rate_hz: float = key(10.0, "how often a tlv module is asked", low=0.1, high=50.0)
    tag_x_m: float = key(0.0, "antenna of the module in base, forward", low=-10.0, high=10.0)
    tag_y_m: float = key(0.0, "the same, to the left", low=-10.0, high=10.0)
    tag_z_m: float = key(0.5, "the same, above the floor", low=0.0, high=10.0)
    noise_m: float = key(
        0.1, "standard deviation of one range with nothing in the way; learnt from then on", low=0.01, high=1.0
    )
    marks: bool = key(True, "look for the marks and lamps of beacons.file, where it has any")
    family: str = key(
        "tag36h11", "of the marks", choices=("tag36h11", "tag25h9", "tag16h5", "aruco_4x4", "aruco_5x5", "aruco_6x6")
    )
    marks_every: int = key(3, "look for them in every so many pictures, and in all of them in doubt", low=1, high=100)
