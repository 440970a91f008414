"""Target capture (Problem 1 of the paper): an observer and a steering law, put together into a `Scheme`.

Any observer goes with either law. What a scheme does, in order: it stands still until its observer has a
first estimate ("drift" turns already); turns at ω̄ for a moment, and again whenever the bearing is too
uncertain to steer by (PROBE); steers to the target (TRACK); stops inside the capture radius (REST).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.guidance import kalman, lq, luenberger, model, seek, seek_steer
from companion.guidance.drift import Noise
from companion.guidance.kalman import Gaussian
from companion.guidance.model import Lifted
from companion.guidance.scheme import PROBE, REST, TRACK, UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings

FIRST_RANGES = 5
"""The Kalman filter starts from the median of this many ranges."""
REJECTION_MEMORY = 0.93
"""Forgetting factor, per range, of the average that starts a locked-out Kalman filter afresh."""
NEAR_RANGE_M = 0.2
"""The noise of d²/2 is never taken for smaller than at this range."""


class Parameters(NamedTuple):
    """The settings as floats, for the functions below; see `GuidanceSettings` for their meaning."""

    v: float
    omega_max: float
    radius: float
    stop_margin: float
    lag: float
    first_turn: float
    probe_turn_s: float
    probe_sigma: float
    turn_through: float
    q1: float
    q2: float
    r: float
    q_position: float
    q_turn: float
    gate_sigma: float
    pole: float
    omega_floor: float
    bearing_is_known: bool
    bearing: float


class Capture(NamedTuple):
    """State of a capture scheme: an observer's and what the command remembers.

    `turn` is +1.0 while turning left and −1.0 while turning right, `probed_s` the time since the first
    estimate while it is shorter than the probing turn, `rests` True inside the capture radius.
    """

    accepted: float
    observer: Any
    turn: float
    probed_s: float
    rests: bool


# -------------------------------------------------------------------------------------- Kalman observer


class KalmanObserver(NamedTuple):
    """Belief, the latest measurements of d²/2 until there are enough, and the average rejection rate."""

    belief: Gaussian
    seen: int
    recent: tuple[float, float, float, float, float]
    rejected: float


def kalman_initial(p: Parameters) -> Capture:
    """No range yet."""
    nothing = Gaussian(Lifted(0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return Capture(0.0, KalmanObserver(nothing, 0, (0.0, 0.0, 0.0, 0.0, 0.0), 0.0), p.first_turn, 0.0, False)


def kalman_predict(
    p: Parameters, s: Capture, dt_s: float, forward_m_s: float, left_m_s: float, yaw_rate_rad_s: float
) -> Capture:
    """The vehicle moved so for dt_s."""
    o = s.observer
    if o.seen < FIRST_RANGES:
        return s
    m = model.step(dt_s, forward_m_s, left_m_s, yaw_rate_rad_s)
    belief = kalman.predict(o.belief, m, dt_s, p.q_position, p.q_turn)
    return Capture(
        s.accepted, KalmanObserver(belief, o.seen, o.recent, o.rejected), s.turn, s.probed_s, s.rests
    )


def kalman_update(
    p: Parameters,
    s: Capture,
    beacon: int,
    range_m: float,
    sigma_m: float,
    dh_m: float,
    sigma_dh_m: float,
) -> Capture:
    """One slant range."""
    o = s.observer
    if o.seen < FIRST_RANGES:
        m = kalman.measured(range_m, sigma_m, dh_m, sigma_dh_m, max(range_m, NEAR_RANGE_M))
        recent = (m.y, o.recent[0], o.recent[1], o.recent[2], o.recent[3])
        belief = o.belief
        if o.seen + 1 == FIRST_RANGES:
            belief = kalman.start(kalman.Measured(kalman.median_of_five(recent), m.variance))
        return Capture(1.0, KalmanObserver(belief, o.seen + 1, recent, 0.0), s.turn, s.probed_s, s.rests)
    expected_m = math.sqrt(max(2.0 * o.belief.x.x1 + dh_m * dh_m, NEAR_RANGE_M * NEAR_RANGE_M))
    m = kalman.measured(range_m, sigma_m, dh_m, sigma_dh_m, expected_m)
    if kalman.is_plausible(o.belief, m, p.gate_sigma):
        o = KalmanObserver(kalman.update(o.belief, m), o.seen, o.recent, REJECTION_MEMORY * o.rejected)
        return Capture(1.0, o, s.turn, s.probed_s, s.rests)
    rejected = REJECTION_MEMORY * o.rejected + 1.0 - REJECTION_MEMORY
    # a filter that believes hardly any range any more is wrong itself: a gate must never lock itself out
    seen = o.seen if rejected <= 0.5 else 0
    return Capture(0.0, KalmanObserver(o.belief, seen, o.recent, rejected), s.turn, s.probed_s, s.rests)


def kalman_knowledge(p: Parameters, s: Capture) -> Knowledge:
    """Distance, bearing and their sigmas; before the first estimate, that nothing is known."""
    o = s.observer
    if o.seen < FIRST_RANGES:
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    d = model.distance(o.belief.x)
    return Knowledge(
        d,
        model.bearing(o.belief.x),
        kalman.distance_sigma(o.belief, d),
        kalman.bearing_sigma(o.belief, d),
    )


# ---------------------------------------------------------------------------------- Luenberger observer


class LuenbergerObserver(NamedTuple):
    """The lifted estimate, the distance measured last, and what the next correction needs."""

    x: Lifted
    seen: int
    d_m: float
    sigma_m: float
    omega_rad_s: float
    since_s: float


def luenberger_initial(p: Parameters) -> Capture:
    """No range yet."""
    return Capture(
        0.0,
        LuenbergerObserver(Lifted(0.0, 0.0, 0.0), 0, 0.0, 0.0, 0.0, 0.0),
        p.first_turn,
        p.probe_turn_s if p.bearing_is_known else 0.0,
        False,
    )


def luenberger_predict(
    p: Parameters, s: Capture, dt_s: float, forward_m_s: float, left_m_s: float, yaw_rate_rad_s: float
) -> Capture:
    """The vehicle moved so for dt_s: Ā x̂ + δ of Eq. (23)."""
    o = s.observer
    if o.seen == 0:
        return s
    x = model.flow(o.x, model.step(dt_s, forward_m_s, left_m_s, yaw_rate_rad_s))
    o = LuenbergerObserver(x, o.seen, o.d_m, o.sigma_m, yaw_rate_rad_s, o.since_s + dt_s)
    return Capture(s.accepted, o, s.turn, s.probed_s, s.rests)


def luenberger_update(
    p: Parameters,
    s: Capture,
    beacon: int,
    range_m: float,
    sigma_m: float,
    dh_m: float,
    sigma_dh_m: float,
) -> Capture:
    """One slant range. Every range is believed, as in the paper; below the height it counts as d = 0."""
    o = s.observer
    y_o = max(model.lifted_range(range_m, dh_m), 0.0)
    d = math.sqrt(2.0 * y_o)
    sigma_d = math.hypot(range_m * sigma_m, dh_m * sigma_dh_m) / max(d, model.NEAR_M)
    if o.seen == 0:
        x = model.lift(d, p.bearing) if p.bearing_is_known else Lifted(y_o, 0.0, 0.0)
    else:
        k = luenberger.gains(o.omega_rad_s, p.v, p.pole, p.omega_floor)
        x = luenberger.correct(o.x, k, y_o, o.since_s)
    return Capture(1.0, LuenbergerObserver(x, 1, d, sigma_d, o.omega_rad_s, 0.0), s.turn, s.probed_s, s.rests)


def luenberger_knowledge(p: Parameters, s: Capture) -> Knowledge:
    """The distance as measured, as below Eq. (26), and the bearing estimated.

    The observer has no covariance: the bearing's sigma is told as π, that is, nothing is claimed.
    """
    o = s.observer
    if o.seen == 0:
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    return Knowledge(o.d_m, model.bearing(o.x), o.sigma_m, math.pi)


# --------------------------------------------------------------------------------------------- steering


def lq_steer(p: Parameters, known: Knowledge, yaw_rate_rad_s: float) -> float:
    """The yaw rate that LQ on the bearing error wants, not yet limited."""
    gains = lq.bearing_gains(known.d_m, p.v, p.lag, p.q1, p.q2, p.r)
    return lq.bearing_yaw_rate(known.theta_rad, yaw_rate_rad_s, gains)


def lq_paper_steer(p: Parameters, known: Knowledge, yaw_rate_rad_s: float) -> float:
    """The yaw rate that the paper's LQ law wants, not yet limited."""
    gains = lq.paper_gains(known.d_m, known.theta_rad, p.v, p.q1, p.q2, p.r)
    return lq.paper_yaw_rate(known.d_m, known.theta_rad, gains)


def decide(
    p: Parameters, s: Capture, known: Knowledge, wanted_rad_s: float, dt_s: float, yaw_rate_rad_s: float
) -> tuple[Capture, Command]:
    """Stand, probe, steer or rest, given what is known and the yaw rate that the steering law wants."""
    if known.sigma_d_m >= UNKNOWN_M:
        # a filter that starts afresh probes afresh
        probed_s = p.probe_turn_s if p.bearing_is_known else 0.0
        return Capture(s.accepted, s.observer, s.turn, probed_s, False), Command(0.0, 0.0, PROBE)
    if model.is_captured(known.d_m, p.radius, p.stop_margin, s.rests):
        return Capture(s.accepted, s.observer, s.turn, s.probed_s, True), Command(0.0, 0.0, REST)
    omega = model.clip(wanted_rad_s, p.omega_max)
    purpose = TRACK
    turns = abs(yaw_rate_rad_s) > 0.5 * p.omega_max
    if s.probed_s < p.probe_turn_s or (known.sigma_theta_rad > p.probe_sigma and abs(omega) < p.omega_max):
        omega = s.turn * p.omega_max
        purpose = PROBE
    elif abs(known.theta_rad) > math.pi - p.turn_through and turns and omega * yaw_rate_rad_s < 0.0:
        # almost straight astern, turning on is as near as turning back
        omega = math.copysign(p.omega_max, yaw_rate_rad_s)
    turn = s.turn if omega == 0.0 else math.copysign(1.0, omega)
    probed_s = min(s.probed_s + dt_s, p.probe_turn_s)
    return Capture(s.accepted, s.observer, turn, probed_s, False), Command(p.v, omega, purpose)


def kalman_lq_command(
    p: Parameters, s: Capture, dt_s: float, yaw_rate_rad_s: float
) -> tuple[Capture, Command]:
    """Kalman filter and LQ on the bearing error."""
    known = kalman_knowledge(p, s)
    return decide(p, s, known, lq_steer(p, known, yaw_rate_rad_s), dt_s, yaw_rate_rad_s)


def kalman_lq_paper_command(
    p: Parameters, s: Capture, dt_s: float, yaw_rate_rad_s: float
) -> tuple[Capture, Command]:
    """Kalman filter and the paper's LQ law."""
    known = kalman_knowledge(p, s)
    return decide(p, s, known, lq_paper_steer(p, known, yaw_rate_rad_s), dt_s, yaw_rate_rad_s)


def luenberger_lq_command(
    p: Parameters, s: Capture, dt_s: float, yaw_rate_rad_s: float
) -> tuple[Capture, Command]:
    """The paper's observer and LQ on the bearing error."""
    known = luenberger_knowledge(p, s)
    return decide(p, s, known, lq_steer(p, known, yaw_rate_rad_s), dt_s, yaw_rate_rad_s)


def luenberger_lq_paper_command(
    p: Parameters, s: Capture, dt_s: float, yaw_rate_rad_s: float
) -> tuple[Capture, Command]:
    """The paper's observer and law: the faithful scheme."""
    known = luenberger_knowledge(p, s)
    return decide(p, s, known, lq_paper_steer(p, known, yaw_rate_rad_s), dt_s, yaw_rate_rad_s)


_COMMANDS: dict[tuple[str, str], Callable[..., tuple[Any, Command]]] = {
    ("kalman", "lq"): kalman_lq_command,
    ("kalman", "lq-paper"): kalman_lq_paper_command,
    ("luenberger", "lq"): luenberger_lq_command,
    ("luenberger", "lq-paper"): luenberger_lq_paper_command,
}


def parameters(settings: GuidanceSettings, yaw_rate_lag_s: float) -> Parameters:
    """The settings as floats."""
    is_kalman = settings.observer == "kalman"
    q1, q2 = settings.lq_q if settings.controller == "lq" else settings.lq_paper_q
    return Parameters(
        v=settings.speed_m_s,
        omega_max=settings.yaw_rate_max_rad_s,
        radius=settings.capture_radius_m,
        stop_margin=settings.stop_margin_m,
        lag=yaw_rate_lag_s,
        first_turn=1.0 if settings.first_turn == "left" else -1.0,
        probe_turn_s=settings.probe_turn_s,
        # the paper's observer tells no sigma to probe by
        probe_sigma=settings.probe_sigma_rad if is_kalman else 2.0 * math.pi,
        turn_through=settings.turn_through_rad,
        q1=q1,
        q2=q2,
        r=settings.lq_r if settings.controller == "lq" else settings.lq_paper_r,
        q_position=settings.kalman_position_noise,
        q_turn=settings.kalman_turn_noise,
        gate_sigma=settings.kalman_gate_sigma,
        pole=settings.luenberger_pole_rad_s,
        omega_floor=settings.luenberger_yaw_rate_floor_rad_s,
        bearing_is_known=settings.initial_bearing_rad is not None,
        bearing=settings.initial_bearing_rad or 0.0,
    )


def _noise(settings: GuidanceSettings, share: float) -> Noise:
    """What is expected of the dead reckoning, all sigmas and variances reduced to a share."""
    return Noise(
        drift_m_s=settings.drift_m_s * share,
        drift=settings.kalman_drift_noise * share,
        position=settings.kalman_position_noise * share,
        turn=settings.kalman_turn_noise * share,
    )


def seek_parameters(
    settings: GuidanceSettings, yaw_rate_lag_s: float, velocity_lag_s: float
) -> seek.SeekParameters:
    """The settings as floats, for the observer "drift"."""
    paper_law = settings.controller == "lq-paper"
    q1, q2 = settings.lq_paper_q if paper_law else settings.lq_q
    return seek.SeekParameters(
        v=settings.speed_m_s,
        omega_max=settings.yaw_rate_max_rad_s,
        radius=settings.capture_radius_m,
        lag=yaw_rate_lag_s,
        velocity_lag=velocity_lag_s,
        first_turn=1.0 if settings.first_turn == "left" else -1.0,
        search_turn_s=settings.search_turn_s,
        turn_through=settings.turn_through_rad,
        turn_on_spot=settings.turn_on_spot_rad,
        q1=q1,
        q2=q2,
        r=settings.lq_paper_r if paper_law else settings.lq_r,
        gate_sigma=settings.kalman_gate_sigma,
        offset=settings.range_offset_m,
        stop_sigma=settings.stop_sigma,
        calm=_noise(settings, settings.trust),
        loose=_noise(settings, 1.0),
        paper_law=paper_law,
    )


def capture(settings: GuidanceSettings, yaw_rate_lag_s: float, velocity_lag_s: float = 0.3) -> Scheme:
    """The scheme that the settings select, for a vehicle that lags its commands by so much.

    It knows one beacon: the beacon number of a range is ignored.
    """
    if settings.observer == "drift":
        return Scheme(
            seek_parameters(settings, yaw_rate_lag_s, velocity_lag_s),
            seek.initial,
            seek.predict,
            seek.update,
            seek_steer.command,
            seek.knowledge,
        )
    p = parameters(settings, yaw_rate_lag_s)
    command = _COMMANDS[settings.observer, settings.controller]
    if settings.observer == "kalman":
        return Scheme(p, kalman_initial, kalman_predict, kalman_update, command, kalman_knowledge)
    return Scheme(p, luenberger_initial, luenberger_predict, luenberger_update, command, luenberger_knowledge)
