"""The design analysis: what LQ guarantees, and that the delay margin means what it says."""

from __future__ import annotations

import math
from pathlib import Path

import control
import numpy as np
import pytest

from companion.bench import design
from companion.guidance import model
from companion.guidance.settings import GuidanceSettings


@pytest.mark.parametrize("lag", [0.0, 0.2, 0.47])
def test_the_default_has_the_margins_that_lq_guarantees(lag: float) -> None:
    report = design.design(GuidanceSettings(), lag, 0.0)
    assert report.warnings == ()
    for point in report.points:
        assert point.is_stable
        assert math.degrees(point.phase_margin_rad) >= 60.0
        assert point.gain_margin_low <= 0.5
        assert point.gain_margin_high == math.inf


@pytest.mark.parametrize("controller", ["lq", "lq-paper"])
def test_dead_time_up_to_the_delay_margin_is_borne_and_more_is_not(controller: str) -> None:
    settings = GuidanceSettings(controller="lq" if controller == "lq" else "lq-paper")
    points = [p for p in design.design(settings, 0.3, 0.0).points if math.isfinite(p.delay_margin_s)]
    for point in points[::7]:
        loop = design._loop(
            controller, point.gains, model.jacobian(point.distance_m, point.bearing_rad, 0.5), 0.3
        )
        for share, stable in ((0.9, True), (1.1, False)):
            dead = control.ss(control.tf(*control.pade(share * point.delay_margin_s, 8)))
            poles = control.feedback(loop * dead, 1).poles()
            assert bool(np.all(np.real(poles) < 0.0)) is stable


def test_a_vehicle_too_slow_for_the_gains_is_warned_of() -> None:
    report = design.design(GuidanceSettings(), 0.2, 0.5)
    assert any("dead time of 0.500 s" in warning for warning in report.warnings)
    fits = design.design(GuidanceSettings(), 0.47, 0.15)
    assert fits.warnings == ()


def test_the_papers_law_is_told_to_be_a_relay() -> None:
    report = design.design(GuidanceSettings(controller="lq-paper"), 0.2, 0.0)
    assert any("relay" in warning for warning in report.warnings)
    assert {p.bearing_rad for p in report.points} == set(design.BEARINGS_RAD["lq-paper"])


def test_text_and_picture(tmp_path: Path) -> None:
    report = design.design(GuidanceSettings(), 0.47, 0.5)
    text = design.table(report)
    assert "warning: " in text
    assert len(text.splitlines()) == 3 + design.DISTANCES // design.TABLE_STRIDE + len(report.warnings)
    path = design.plot(report, tmp_path / "new")
    assert path.read_bytes().startswith(b"\x89PNG")
