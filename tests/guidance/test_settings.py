"""The `[guidance]` table: what it refuses."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from companion.guidance.settings import GuidanceSettings


def test_the_default_assumes_no_bearing() -> None:
    settings = msgspec.convert({}, GuidanceSettings)
    assert (settings.observer, settings.controller) == ("drift", "lq")
    assert settings.initial_bearing_rad is None


@pytest.mark.parametrize(
    "table",
    [
        {"speed_m_s": 0.0},
        {"speed_m_s": float("nan")},
        {"yaw_rate_max_rad_s": -1.0},
        {"observer": "guess"},
        {"lq_q": [1.0]},
        {"lq_q": [0.0, 1.0]},
        {"no_such_key": 1},
        {"stop_margin_m": 0.5, "capture_radius_m": 0.5},
        {"initial_bearing_rad": 0.3},
        {"initial_bearing_rad": 4.0, "observer": "luenberger"},
    ],
)
def test_refuses_what_makes_no_sense(table: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(table, GuidanceSettings)
