"""What the senses of motion have learnt, for the health message."""

from __future__ import annotations

import math

import numpy as np

from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.senses.motion_senses import MotionSenses
from ceilvo.daemon.odometry.senses.slip import AXES


def learnt(senses: MotionSenses, config: Senses) -> dict[str, object]:
    """For people: what is known of wheels, gyro and delays, with standard deviations."""
    out: dict[str, object] = {}
    if config.time:
        lags = {"wheels": senses.wheels_lag.state, "gyro": senses.gyro_lag.state}
        known = {name: s for name, s in lags.items() if s.delay_s is not None}
        out["delay_ms"] = {name: 1e3 * s.delay_s for name, s in known.items() if s.delay_s is not None}
        out["delay_sigma_ms"] = {name: 1e3 * s.sigma_s for name, s in known.items()}
        out["delay_jumps"] = sum(s.jumps for s in lags.values())
    if config.wheels:
        w, names = senses.wheels.state, senses.wheels.names
        out["wheel_scale_off"] = dict(zip(names, w.off.tolist(), strict=True))
        out["wheel_scale_sigma"] = dict(zip(names, np.sqrt(np.diagonal(w.cov)).tolist(), strict=True))
        out["wheel_noise"] = dict(zip((*AXES, "turning_per_rad"), np.sqrt(w.noise).tolist(), strict=True))
        out["slips"] = dict(zip(AXES, senses.slip.state.began.astype(int).tolist(), strict=True))
    if config.gyro != "none":
        bias, scale = senses.gyro.state.bias_scale.tolist()
        sigma = np.sqrt(np.diagonal(senses.gyro.cov))
        out["gyro_bias_dps"], out["gyro_bias_sigma_dps"] = math.degrees(bias), math.degrees(float(sigma[0]))
        out["gyro_scale_off"], out["gyro_scale_sigma"] = scale, float(sigma[1])
    return out
