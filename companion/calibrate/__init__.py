"""`companion calibrate`: bias and noise of a beacon's ranges, from ranges over known distances.

An error is measured less true distance. Of each distance the outliers are left out, then mean and spread are
taken; over several distances a constant, a line over distance or a line over received power is fitted to the
means. An antenna delay makes a constant, the power-dependent detection of a UWB receiver a line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from statistics import fmean, median, pstdev
from typing import NamedTuple

import msgspec

from companion.network_settings import BeaconSettings

LEAST = 20
"""Fewer ranges of a distance tell nothing of their spread."""
_OUTLIER_SIGMAS = 4.0
_OUTLIER_FLOOR_M = 0.05
_MATTERS_M = 0.02
"""Means that differ by less than this are one constant."""
_UNUSUAL_M = 1.0
"""Errors are centimetres, or decimetres where the antenna delay was never set."""
_MATTERS_DB = 3.0
"""Powers that differ by less tell no dependence on power."""


class CalibrationError(Exception):
    """The ranges tell nothing, or nothing that can be configured; the text is one line for a person."""


class Point(NamedTuple):
    """One range that was measured: seconds from the first of its recording, metres, dBm."""

    t_s: float
    range_m: float
    power_dbm: float | None = None


class Fit(Enum):
    """What the bias is taken to depend on."""

    AUTO = "auto"
    CONSTANT = "constant"
    DISTANCE = "distance"
    POWER = "power"


class Group(NamedTuple):
    """The ranges over one distance, and what they tell."""

    distance_m: float
    kept: tuple[Point, ...]
    left_out: tuple[Point, ...]
    mean_m: float
    """Mean error."""
    sigma_m: float
    power_dbm: float | None
    """Mean received power, where every range tells it."""
    drift_m: float
    """Mean error of the second half less that of the first."""

    def error_m(self, point: Point) -> float:
        """Measured less true distance."""
        return point.range_m - self.distance_m


class Calibration(NamedTuple):
    """What is configured, and what it was made from."""

    beacon: str
    fit: Fit
    why: str
    groups: tuple[Group, ...]
    bias_m: float
    bias_per_m: float
    bias_per_db: float
    power_dbm: float
    sigma_m: float
    residual_m: float
    """Largest mean error that is left at one of the distances."""

    def bias_at_m(self, distance_m: float, power_dbm: float | None) -> float:
        """The bias over a true distance, as the flight would subtract it."""
        db = 0.0 if power_dbm is None else power_dbm - self.power_dbm
        return self.bias_m + self.bias_per_m * distance_m + self.bias_per_db * db


def group(distance_m: float, points: Sequence[Point], name: str) -> Group:
    """What the ranges over one distance tell. Raises CalibrationError where they are too few."""
    if not points:
        raise CalibrationError(f"{name}: no ranges in the seconds given for {distance_m:g} m")
    middle_m = median(p.range_m for p in points)
    spread_m = 1.4826 * median(abs(p.range_m - middle_m) for p in points)
    most_m = max(_OUTLIER_SIGMAS * spread_m, _OUTLIER_FLOOR_M)
    kept = tuple(p for p in points if abs(p.range_m - middle_m) <= most_m)
    if len(kept) < LEAST:
        raise CalibrationError(
            f"{name}: {len(kept)} ranges at {distance_m:g} m, at least {LEAST} are needed, better a thousand"
        )
    errors = [p.range_m - distance_m for p in kept]
    powers = [p.power_dbm for p in kept if p.power_dbm is not None]
    half = len(errors) // 2
    return Group(
        distance_m=distance_m,
        kept=kept,
        left_out=tuple(p for p in points if abs(p.range_m - middle_m) > most_m),
        mean_m=fmean(errors),
        sigma_m=pstdev(errors),
        power_dbm=fmean(powers) if len(powers) == len(kept) else None,
        drift_m=fmean(errors[half:]) - fmean(errors[:half]),
    )


def calibrate(beacon: str, groups: Sequence[Group], fit: Fit = Fit.AUTO) -> Calibration:
    """Bias and noise. Raises CalibrationError where the fit asked for is not possible, or absurd."""
    means = [g.mean_m for g in groups]
    distances = [g.distance_m for g in groups]
    powers = [g.power_dbm for g in groups if g.power_dbm is not None]
    can_distance = max(distances) - min(distances) > 0.1 * max(distances)
    can_power = len(powers) == len(groups) and max(powers) - min(powers) >= _MATTERS_DB
    why = "asked for"
    if fit is Fit.AUTO:
        fit, why = _chosen(means, distances, powers if can_power else None, can_distance)
    elif fit is Fit.DISTANCE and not can_distance:
        raise CalibrationError("a fit over distance needs two distances that differ by more than a tenth")
    elif fit is Fit.POWER and not can_power:
        raise CalibrationError(
            "a fit over power needs two distances, `rssi_dbm` in every range, "
            f"and powers {_MATTERS_DB:g} dB apart"
        )
    middle_dbm = fmean(powers) if fit is Fit.POWER else BeaconSettings().power_dbm
    bias_m, per_m, per_db = fmean(means), 0.0, 0.0
    if fit is Fit.DISTANCE:
        bias_m, per_m = _line(distances, means)
    elif fit is Fit.POWER:
        bias_m, per_db = _line([p - middle_dbm for p in powers], means)
    count = sum(len(g.kept) for g in groups)
    sigma_m = math.sqrt(sum(len(g.kept) * g.sigma_m**2 for g in groups) / count)
    found = Calibration(
        beacon, fit, why, tuple(groups), bias_m, per_m, per_db, middle_dbm, max(sigma_m, 0.005), 0.0
    )
    left_m = max(abs(g.mean_m - found.bias_at_m(g.distance_m, g.power_dbm)) for g in groups)
    found = found._replace(residual_m=left_m)
    _check(found)
    return found


def _chosen(
    means: list[float], distances: list[float], powers: list[float] | None, can_distance: bool
) -> tuple[Fit, str]:
    """The simplest that explains the means."""
    if len(means) == 1:
        return Fit.CONSTANT, "one distance tells no more"
    differ_m = max(means) - min(means)
    if differ_m < _MATTERS_M:
        return Fit.CONSTANT, f"the means differ by {differ_m:.3f} m only"
    left = {Fit.CONSTANT: pstdev(means)}
    if can_distance:
        left[Fit.DISTANCE] = _scatter(distances, means)
    if powers is not None:
        left[Fit.POWER] = _scatter(powers, means)
    best = min(left, key=lambda fit: round(left[fit], 4))
    if left[best] > 0.5 * left[Fit.CONSTANT]:
        return Fit.CONSTANT, f"the means differ by {differ_m:.3f} m, and no line explains half of that"
    return best, f"the means differ by {differ_m:.3f} m, {left[best]:.3f} m off the line"


def _line(xs: Sequence[float], ys: Sequence[float]) -> tuple[float, float]:
    """Least squares: value at 0, and slope."""
    x0, y0 = fmean(xs), fmean(ys)
    slope = sum((x - x0) * (y - y0) for x, y in zip(xs, ys, strict=True)) / sum((x - x0) ** 2 for x in xs)
    return y0 - slope * x0, slope


def _scatter(xs: Sequence[float], ys: Sequence[float]) -> float:
    at_0, slope = _line(xs, ys)
    return math.sqrt(fmean((y - at_0 - slope * x) ** 2 for x, y in zip(xs, ys, strict=True)))


def _check(c: Calibration) -> None:
    values = {
        "bias_m": c.bias_m,
        "bias_per_m": c.bias_per_m,
        "bias_per_db": c.bias_per_db,
        "sigma_m": c.sigma_m,
    }
    try:
        msgspec.convert(values, BeaconSettings)
    except msgspec.ValidationError as error:
        found = ", ".join(f"{key} = {value:.4g}" for key, value in values.items())
        raise CalibrationError(
            f"{found}: no UWB range is that wrong ({error}); are the distances right, and in order?"
        ) from error


def text(c: Calibration, command: str) -> str:
    """The table of the configuration, with what it was made from as comments."""
    lines = [f"# {command}"]
    for g in c.groups:
        power = "" if g.power_dbm is None else f", {g.power_dbm:.1f} dBm"
        lines.append(
            f"# {g.distance_m:8.3f} m: {len(g.kept)} ranges, mean error {g.mean_m:+.3f} m, "
            f"sigma {g.sigma_m:.3f} m, {len(g.left_out)} outliers left out{power}"
        )
        if abs(g.drift_m) > max(0.5 * g.sigma_m, _MATTERS_M):
            lines.append(
                f"#   the second half reads {g.drift_m:+.3f} m from the first: let it warm up, hold it still"
            )
        if len(g.left_out) > 0.2 * (len(g.kept) + len(g.left_out)):
            lines.append("#   a fifth or more are outliers: is the line of sight clear?")
    lines.append(f"# fit: {c.fit.value} ({c.why}); at most {c.residual_m:.3f} m is left at a distance")
    if max(abs(g.mean_m) for g in c.groups) > _UNUSUAL_M:
        lines.append("# errors of a metre or more are unusual: are the distances those between the antennas?")
    reach = [g.distance_m for g in c.groups]
    if c.fit is Fit.CONSTANT and len(c.groups) == 1:
        lines.append("# a bias varies with distance by up to 0.3 m: measure at two or more to see it")
    elif c.fit is not Fit.CONSTANT:
        lines.append(f"# holds from {min(reach):g} to {max(reach):g} m")
    lines += [f"[beacons.{c.beacon}]", f"bias_m = {c.bias_m:.3f}"]
    if c.fit is Fit.DISTANCE:
        lines.append(f"bias_per_m = {c.bias_per_m:.5f}")
    if c.fit is Fit.POWER:
        lines += [f"bias_per_db = {c.bias_per_db:.5f}", f"power_dbm = {c.power_dbm:.1f}"]
    lines.append(f"sigma_m = {c.sigma_m:.3f}")
    return "\n".join(lines) + "\n"
