"""Published peers and a limit, behind the same `Scheme` interface; for comparison only, none of them flies.

The laws turn on the range and its rate, which nobody measures: all are fed the same gated constant-velocity
Kalman filter on the horizontal distance, and all stop by the same rule as the default. Their gains were tuned
lightly, by a coarse grid on 400 nominal flights, for a small mean extra path.

The control law that the paper compares itself with, its reference [10] (S. Güler, B. Fidan, Target capture
and station keeping of fixed speed vehicles without self-location information, European Journal of Control,
2018), is not among them: its exact form was not available, and a guess would not be a comparison.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from companion.bench.plant import Truth
from companion.guidance import lq, model
from companion.guidance.scheme import PROBE, REST, TRACK, UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings

GATE_SIGMA = 4.0
REJECTION_MEMORY = 0.93
NEAR_M = 0.2
"""The noise of the horizontal distance is never taken for larger than at this distance."""


class Parameters(NamedTuple):
    """What all peers share, the filter's acceleration noise (m²/s³), and the law's own gains."""

    v: float
    omega_max: float
    radius: float
    stop_margin: float
    acceleration: float
    law: Any


class Rate(NamedTuple):
    """The constant-velocity filter: distance and its rate with their covariance, and how often it
    disbelieved."""

    d: float
    rate: float
    p11: float
    p12: float
    p22: float
    rejected: float


class State(NamedTuple):
    """State of a peer; `memory` is the law's own. A rate with p11 < 0 has not begun."""

    accepted: float
    range: Rate
    memory: Any
    rests: bool


UNBEGUN = Rate(0.0, 0.0, -1.0, 0.0, 0.0, 0.0)


def predict(p: Parameters, s: State, dt_s: float, forward: float, left: float, yaw_rate: float) -> State:
    """Constant range rate, disturbed by white acceleration. The peers do not use the vehicle's own motion."""
    d, rate, p11, p12, p22, rejected = s.range
    if p11 < 0.0:
        return s
    q = p.acceleration
    p11 += 2.0 * dt_s * p12 + dt_s * dt_s * p22 + q * dt_s**3 / 3.0
    p12 += dt_s * p22 + 0.5 * q * dt_s * dt_s
    return State(
        s.accepted, Rate(d + rate * dt_s, rate, p11, p12, p22 + q * dt_s, rejected), s.memory, s.rests
    )


def update(
    p: Parameters, s: State, beacon: int, range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float
) -> State:
    """One slant range, as a horizontal distance; gated, and begun anew where the gate locks itself out."""
    measured = math.sqrt(max(range_m * range_m - dh_m * dh_m, 0.0))
    d, rate, p11, p12, p22, rejected = s.range
    stretch = math.hypot(range_m * sigma_m, dh_m * sigma_dh_m) / max(measured, NEAR_M)
    noise = stretch * stretch
    if p11 < 0.0 or rejected > 0.5:
        return State(1.0, Rate(measured, 0.0, noise, 0.0, p.v * p.v, 0.0), s.memory, s.rests)
    innovation = measured - d
    total = p11 + noise
    if innovation * innovation > GATE_SIGMA * GATE_SIGMA * total:
        rejected = REJECTION_MEMORY * rejected + 1.0 - REJECTION_MEMORY
        return State(0.0, Rate(d, rate, p11, p12, p22, rejected), s.memory, s.rests)
    k1, k2 = p11 / total, p12 / total
    after = Rate(
        d + k1 * innovation,
        rate + k2 * innovation,
        (1.0 - k1) * p11,
        (1.0 - k1) * p12,
        p22 - k2 * p12,
        REJECTION_MEMORY * rejected,
    )
    return State(1.0, after, s.memory, s.rests)


def knowledge(p: Parameters, s: State) -> Knowledge:
    """The distance; a peer knows no bearing."""
    if s.range.p11 < 0.0:
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    return Knowledge(max(s.range.d, 0.0), 0.0, math.sqrt(s.range.p11), math.pi)


def _act(p: Parameters, s: State, memory: Any, omega: float) -> tuple[State, Command]:
    """Stand before the first range, rest inside the radius, else turn as the law wants."""
    if s.range.p11 < 0.0:
        return s, Command(0.0, 0.0, PROBE)
    if model.is_captured(s.range.d, p.radius, p.stop_margin, s.rests):
        return State(s.accepted, s.range, memory, True), Command(0.0, 0.0, REST)
    return State(s.accepted, s.range, memory, False), Command(p.v, model.clip(omega, p.omega_max), TRACK)


def _peer(settings: GuidanceSettings, acceleration: float, law: Any) -> Parameters:
    return Parameters(
        settings.speed_m_s,
        settings.yaw_rate_max_rad_s,
        settings.capture_radius_m,
        settings.stop_margin_m,
        acceleration,
        law,
    )


class Nothing(NamedTuple):
    """The memory of a law that has none."""

    unused: float = 0.0


def forgetful_initial(p: Parameters) -> State:
    """No range yet, and nothing else to remember."""
    return State(0.0, UNBEGUN, Nothing(), False)


# ------------------------------------------------------------------------------------ Matveev et al. 2011


class Matveev(NamedTuple):
    """Wanted closing speed as a share of v, and the distance `delta` over which it fades out."""

    share: float = 0.95
    delta: float = 0.3


def matveev_command(p: Parameters, s: State, dt_s: float, yaw_rate: float) -> tuple[State, Command]:
    """ω = ω̄ sgn(ḋ + χ(d − d0)), χ linear and saturated at μ; here d0 = 0."""
    wanted = p.law.share * p.v * model.clip(s.range.d / p.law.delta, 1.0)
    return _act(p, s, s.memory, math.copysign(p.omega_max, s.range.rate + wanted))


def matveev(settings: GuidanceSettings) -> Scheme:
    """The sliding mode of A. S. Matveev, H. Teimoori, A. V. Savkin: Range-only measurements based target
    following for wheeled mobile robots, Automatica 47(1), 2011, 177–184.

    It slides along the bearing at which the range falls at the rate μ, a spiral: μ near v is short, but
    chatters and loses the surface to noise.
    """
    p = _peer(settings, 0.3, Matveev())
    return Scheme(p, forgetful_initial, predict, update, matveev_command, knowledge)


# --------------------------------------------------------------------------------------------- Cao 2015


class Cao(NamedTuple):
    """Gain `k` (rad/m), and the radius of the circle whose tangent is flown."""

    k: float = 2.5
    radius: float = 0.2


def cao_command(p: Parameters, s: State, dt_s: float, yaw_rate: float) -> tuple[State, Command]:
    """ω = k (ḋ + v √(1 − (r_a/d)²)), and k ḋ inside r_a."""
    share = min(p.law.radius / max(s.range.d, 1e-3), 1.0)
    return _act(p, s, s.memory, p.law.k * (s.range.rate + p.v * math.sqrt(1.0 - share * share)))


def cao(settings: GuidanceSettings) -> Scheme:
    """The range-rate law of Y. Cao: UAV circumnavigating an unknown target under a GPS-denied environment
    with range-only measurements, Automatica 55, 2015, 150–158 (arXiv:1404.3221).

    Made to circle the target at a greater radius than r_a; with r_a inside the capture radius, its approach
    along the tangent captures.
    """
    p = _peer(settings, 0.05, Cao())
    return Scheme(p, forgetful_initial, predict, update, cao_command, knowledge)


# ---------------------------------------------------------------------------------- Cochran, Krstic 2009


class CochranKrstic(NamedTuple):
    """Amplitude `a` (rad) and frequency of the probing, and the gain `c` of the demodulation."""

    a: float = 1.0
    frequency: float = 1.2
    c: float = 6.0


class Phase(NamedTuple):
    """The time that the probing stands at."""

    t_s: float


def cochran_krstic_initial(p: Parameters) -> State:
    """No range yet, the probing at its beginning."""
    return State(0.0, UNBEGUN, Phase(0.0), False)


def cochran_krstic_command(p: Parameters, s: State, dt_s: float, yaw_rate: float) -> tuple[State, Command]:
    """ω = a Ω cos Ωt + c ξ sin Ωt, ξ = −ḋ."""
    a, frequency, c = p.law
    phase = frequency * s.memory.t_s
    omega = a * frequency * math.cos(phase) - c * s.range.rate * math.sin(phase)
    return _act(p, s, Phase(s.memory.t_s + dt_s), omega)


def cochran_krstic(settings: GuidanceSettings) -> Scheme:
    """The extremum seeking of J. Cochran, M. Krstic: Nonholonomic source seeking with tuning of angular
    velocity, IEEE Transactions on Automatic Control 54(4), 2009, 717–731.

    There ξ is the field, measured ahead of the vehicle, through a washout filter. A tag sits at the vehicle,
    so the range rate takes the washout's place: it is what the probing modulates in phase.
    """
    p = _peer(settings, 0.5, CochranKrstic())
    return Scheme(p, cochran_krstic_initial, predict, update, cochran_krstic_command, knowledge)


# ------------------------------------------------------------------------------- turn on increase, 2025


class TurnOnIncrease(NamedTuple):
    """A range that grows faster than `rate` calls for a turn by `angle`."""

    rate: float = 0.02
    angle: float = 0.5 * math.pi


class Turn(NamedTuple):
    """What is left of the turn under way."""

    left_rad: float


def turn_on_increase_initial(p: Parameters) -> State:
    """No range yet, flying straight."""
    return State(0.0, UNBEGUN, Turn(0.0), False)


def turn_on_increase_command(p: Parameters, s: State, dt_s: float, yaw_rate: float) -> tuple[State, Command]:
    """Straight on while the range falls; where it grows, a turn to the left by a right angle."""
    left_rad = s.memory.left_rad
    if left_rad > 0.0:
        left_rad -= yaw_rate * dt_s
    elif s.range.rate > p.law.rate:
        left_rad = p.law.angle
    return _act(p, s, Turn(left_rad), p.omega_max if left_rad > 0.0 else 0.0)


def turn_on_increase(settings: GuidanceSettings) -> Scheme:
    """The rule published in Sensors 25(14), 2025, article 4497: fly straight, turn by π/2 when the range
    grows."""
    p = _peer(settings, 0.2, TurnOnIncrease())
    return Scheme(p, turn_on_increase_initial, predict, update, turn_on_increase_command, knowledge)


# -------------------------------------------------------------------------------------------- the limit


class PerfectLaw(NamedTuple):
    """The default's LQ weights, and the lag that its gains are made for."""

    lag: float
    q1: float
    q2: float
    r: float


class Perfect(NamedTuple):
    """What the benchmark told last, and whether the vehicle rests."""

    accepted: float
    truth: Truth
    rests: bool


def perfect_initial(p: Parameters) -> Perfect:
    """Told before the first command."""
    return Perfect(1.0, Truth(UNKNOWN_M, 0.0, 0.0, 0.0), False)


def perfect_predict(
    p: Parameters, s: Perfect, dt_s: float, forward: float, left: float, yaw_rate: float
) -> Perfect:
    """Nothing to predict."""
    return s


def perfect_update(
    p: Parameters, s: Perfect, beacon: int, range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float
) -> Perfect:
    """Nothing to learn from a range."""
    return s


def perfect_tell(s: Perfect, truth: Truth) -> Perfect:
    """The truth, from the plant."""
    return Perfect(1.0, truth, s.rests)


def perfect_knowledge(p: Parameters, s: Perfect) -> Knowledge:
    """Everything."""
    return Knowledge(s.truth.d_m, s.truth.theta_rad, 0.0, 0.0)


def perfect_command(p: Parameters, s: Perfect, dt_s: float, yaw_rate: float) -> tuple[Perfect, Command]:
    """LQ on the bearing error, crabbing against a known drift."""
    d, theta, drift_forward, drift_left = s.truth
    if model.is_captured(d, p.radius, p.stop_margin, s.rests):
        return Perfect(1.0, s.truth, True), Command(0.0, 0.0, REST)
    across = drift_forward * math.sin(theta) + drift_left * math.cos(theta)
    error = model.wrap(theta + math.asin(model.clip(across / p.v, 1.0)))
    gains = lq.bearing_gains(d, p.v, p.law.lag, p.law.q1, p.law.q2, p.law.r)
    omega = lq.bearing_yaw_rate(error, yaw_rate, gains)
    return Perfect(1.0, s.truth, False), Command(p.v, model.clip(omega, p.omega_max), TRACK)


def perfect(settings: GuidanceSettings, yaw_rate_lag_s: float) -> Scheme:
    """LQ on the bearing error with the true state: what steering alone costs. Needs `perfect_tell`."""
    q1, q2 = settings.lq_q
    p = _peer(settings, 0.0, PerfectLaw(yaw_rate_lag_s, q1, q2, settings.lq_r))
    return Scheme(p, perfect_initial, perfect_predict, perfect_update, perfect_command, perfect_knowledge)
