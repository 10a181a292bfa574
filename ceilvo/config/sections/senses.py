"""Keys of config.yaml for the senses of motion; see ceilvo.config.schema. All are off by default."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.config.sections.keys import key


@dataclass(frozen=True)
class Senses:
    time: bool = key(
        False, "estimate the delays between camera, wheels and gyro to milliseconds; false = only long ones, roughly"
    )
    wheels: bool = key(False, "learn the wheels' scales and noise while driving, and say when they slip")
    drive: str = key(
        "differential",
        "differential = a scale for each of two wheels, and the track; omni = scales of x, y and theta",
        choices=("differential", "omni"),
    )
    track_m: float = key(0.5, "differential: distance between the wheels, as the base reckons with", low=0.02, high=5.0)
    scale_sigma: float = key(
        0.02, "standard deviation of the wheels' scales and track as commissioned, a share", low=1e-4, high=0.2
    )
    scale_bound: float = key(0.06, "what is learnt stays within this of what was commissioned", low=1e-3, high=0.5)
    gyro: str = key(
        "none",
        "where the yaw rate comes from: base = its registers (base.protocol: 2), topic = Zenoh, <robot>/imu",
        choices=("none", "base", "topic"),
    )
    gyro_noise_dps: float = key(
        0.01, "deg/s of white noise in a bandwidth of 1 Hz, from the gyro's data sheet", low=1e-5, high=10.0
    )
    gyro_bias_dps: float = key(0.5, "deg/s, standard deviation of the bias at the start", low=1e-4, high=20.0)
    gyro_walk_dps: float = key(0.002, "deg/s by which the bias drifts in a second, as its root", low=0.0, high=1.0)
    gyro_scale_sigma: float = key(0.01, "standard deviation of the gyro's scale, a share", low=0.0, high=0.1)

    @property
    def any(self) -> bool:
        """Whether one of them is on."""
        return self.time or self.wheels or self.gyro != "none"
