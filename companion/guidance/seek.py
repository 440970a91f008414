"""Target capture with the lift of `drift`: what its observer does with moves and ranges. `seek_steer` steers.

GATHER until there are five ranges; SEARCH with the bearing open, on its posterior; FOLLOW with the bearing
known. The frame is that of `drift`: dead-reckoned, the heading zero where guidance began.
"""

from __future__ import annotations

import math

import msgspec

from companion.guidance import drift, model
from companion.guidance.drift import DriftLift, Fix, Noise
from companion.guidance.kalman import measured, median_of_five
from companion.guidance.scheme import UNKNOWN_M, Knowledge

GATHER = 0
SEARCH = 1
FOLLOW = 2

FIRST_RANGES = 5
"""The filter starts from the median of this many ranges."""
REJECTION_MEMORY = 0.93
"""Forgetting factor, per range, of the average that starts a locked-out filter afresh."""
SURPRISE_MEMORY = 0.97
"""The same of the average innovation."""
SURPRISE_MAX = 0.4
"""An average innovation of so many sigmas says that the dead reckoning is wrong."""
SPREAD = 0.5
"""Then the target may be elsewhere by this share of its distance."""
NEAR_RANGE_M = 0.2
"""The noise of d²/2 is never taken for smaller than at this range."""
SMOOTHING_S = 0.15
"""The velocity that the vehicle coasts with is the mean over about this time: single moves may jump."""
RECEDES_M = 1.5
"""A target that is steered at and yet gets farther away by this much is looked for afresh."""
HEIGHT_TAU_S = 30.0
"""An error of the height lasts about this long."""


class SeekParameters(msgspec.Struct, frozen=True, gc=False):
    """The settings as floats; see `GuidanceSettings` for their meaning."""

    v: float
    omega_max: float
    radius: float
    lag: float
    velocity_lag: float
    first_turn: float
    search_turn_s: float
    turn_through: float
    turn_on_spot: float
    q1: float
    q2: float
    r: float
    gate_sigma: float
    offset: float
    stop_sigma: float
    calm: Noise
    loose: Noise
    paper_law: bool


class Motion(msgspec.Struct, frozen=True, gc=False):
    """Dead reckoning: heading, smoothed velocity, and the move that the filter has not been told yet."""

    heading: float
    vx: float
    vy: float
    x: float
    y: float
    dt_s: float


class Heard(msgspec.Struct, frozen=True, gc=False):
    """Ranges: how many until there are enough, the latest d²/2 of these, the average rejection rate, the
    average innovation in sigmas, and the last range believed with its height difference."""

    seen: int
    recent: tuple[float, float, float, float, float]
    rejected: float
    surprise: float
    range_m: float
    dh_m: float
    sigma_dh_m: float


class Manner(msgspec.Struct, frozen=True, gc=False):
    """What the command remembers: side of the turn (+1.0 left), resting, turning on the spot, time spent near
    the target."""

    turn: float
    rests: bool
    stands: bool
    near_s: float


class Seeking(msgspec.Struct, frozen=True, gc=False):
    """State of the scheme. `agreed` is the resultant of the bearing's posterior, `nearest_m` the smallest
    distance since the bearing was known."""

    accepted: float
    noise: Noise
    mode: int
    since_s: float
    agreed: float
    nearest_m: float
    motion: Motion
    heard: Heard
    lift: DriftLift
    fix: Fix
    manner: Manner


def initial(p: SeekParameters) -> Seeking:
    """No range yet."""
    z = 0.0
    return Seeking(
        z,
        p.calm,
        GATHER,
        z,
        z,
        z,
        Motion(z, z, z, z, z, z),
        Heard(0, (z, z, z, z, z), z, z, z, z, z),
        drift.start(z, z, p.calm),
        Fix(z, z, z, z, z, z, z),
        Manner(p.first_turn, False, False, z),
    )


def predict(
    p: SeekParameters,
    s: Seeking,
    dt_s: float,
    forward_m_s: float,
    left_m_s: float,
    yaw_rate_rad_s: float,
) -> Seeking:
    """The vehicle moved so for dt_s. The filter follows when the next range comes, with all moves at once."""
    m = s.motion
    middle = m.heading + 0.5 * yaw_rate_rad_s * dt_s
    c, sn = math.cos(middle), math.sin(middle)
    vx = forward_m_s * c - left_m_s * sn
    vy = forward_m_s * sn + left_m_s * c
    share = dt_s / (dt_s + SMOOTHING_S)
    motion = Motion(
        m.heading + yaw_rate_rad_s * dt_s,
        m.vx + share * (vx - m.vx),
        m.vy + share * (vy - m.vy),
        m.x + vx * dt_s,
        m.y + vy * dt_s,
        m.dt_s + dt_s,
    )
    return Seeking(
        s.accepted,
        s.noise,
        s.mode,
        s.since_s,
        s.agreed,
        s.nearest_m,
        motion,
        s.heard,
        s.lift,
        s.fix,
        s.manner,
    )


def caught_up(p: SeekParameters, s: Seeking) -> Seeking:
    """The filter and the read-out moved along."""
    m = s.motion
    if m.dt_s <= 0.0:
        return s
    lift, q, h = s.lift, s.fix, s.heard
    if s.mode != GATHER:
        height = h.dh_m * h.sigma_dh_m
        lift = drift.predict(lift, s.noise, q, 2.0 * height * height / HEIGHT_TAU_S, m.dt_s, m.x, m.y)
        q = Fix(q.x - m.x - q.wx * m.dt_s, q.y - m.y - q.wy * m.dt_s, q.xx, q.xy, q.yy, q.wx, q.wy)
    still = Motion(m.heading, m.vx, m.vy, 0.0, 0.0, 0.0)
    since_s = s.since_s + m.dt_s
    return Seeking(
        s.accepted, s.noise, s.mode, since_s, s.agreed, s.nearest_m, still, s.heard, lift, q, s.manner
    )


def update(
    p: SeekParameters,
    s: Seeking,
    beacon: int,
    range_m: float,
    sigma_m: float,
    dh_m: float,
    sigma_dh_m: float,
) -> Seeking:
    """One slant range."""
    if s.mode == GATHER:
        return gathered(p, s, range_m, sigma_m, dh_m, sigma_dh_m)
    s = caught_up(p, s)
    f, h = s.lift, s.heard
    expected_m = math.sqrt(max(2.0 * f.x1 + dh_m * dh_m, NEAR_RANGE_M * NEAR_RANGE_M))
    # an error of the height stays the same from range to range: it is told to the read-out, not to the filter
    m = measured(range_m, sigma_m, dh_m, 0.0, expected_m)
    innovation = m.y - f.x1
    variance = max(f.p00, 0.0) + m.variance
    rejected = REJECTION_MEMORY * h.rejected
    if innovation * innovation > p.gate_sigma * p.gate_sigma * variance:
        rejected += 1.0 - REJECTION_MEMORY
        heard = Heard(h.seen, h.recent, rejected, h.surprise, h.range_m, dh_m, sigma_dh_m)
        s = Seeking(
            0.0, s.noise, s.mode, s.since_s, s.agreed, s.nearest_m, s.motion, heard, f, s.fix, s.manner
        )
        # a filter that believes hardly any range any more is wrong itself: a gate must never lock itself out
        return afresh(s, p.loose) if rejected > 0.5 else s
    nearest_m = min(s.nearest_m, drift.distance(f))
    surprise = SURPRISE_MEMORY * h.surprise + (1.0 - SURPRISE_MEMORY) * innovation / math.sqrt(variance)
    heard = Heard(h.seen, h.recent, rejected, surprise, expected_m, dh_m, sigma_dh_m)
    lift = drift.correct(f, innovation, variance)
    s = Seeking(1.0, s.noise, s.mode, s.since_s, s.agreed, nearest_m, s.motion, heard, lift, s.fix, s.manner)
    if s.mode == FOLLOW and abs(surprise) > SURPRISE_MAX and s.noise.drift_m_s != p.loose.drift_m_s:
        # ranges that differ to one side again and again: the vehicle moves otherwise than it says
        s = loosened(p, s)
    if s.mode == FOLLOW and drift.distance(f) > nearest_m + RECEDES_M:
        return afresh(s, p.loose)
    return s


def gathered(
    p: SeekParameters, s: Seeking, range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float
) -> Seeking:
    """One of the first ranges: with the last of them the search begins, at their median."""
    h, m = s.heard, s.motion
    y = measured(range_m, sigma_m, dh_m, 0.0, max(range_m, NEAR_RANGE_M)).y
    recent = (y, h.recent[0], h.recent[1], h.recent[2], h.recent[3])
    heard = Heard(h.seen + 1, recent, 0.0, 0.0, range_m, dh_m, sigma_dh_m)
    mode, lift = s.mode, s.lift
    ends = heard.seen >= FIRST_RANGES
    motion = Motion(m.heading, m.vx, m.vy, 0.0, 0.0, 0.0) if ends or h.seen == 0 else m
    if ends:
        mode = SEARCH
        d = max(math.sqrt(max(2.0 * median_of_five(recent), 0.0)), 0.5)
        sigma_m *= max(range_m / d, 1.0)
        # the variance of a median of five, and half of the way since the first, to an unknown side
        variance = 0.3 * sigma_m * sigma_m + 0.25 * (m.x * m.x + m.y * m.y)
        lift = drift.start(d, variance, s.noise)
    return Seeking(1.0, s.noise, mode, 0.0, 0.0, UNKNOWN_M, motion, heard, lift, s.fix, s.manner)


def loosened(p: SeekParameters, s: Seeking) -> Seeking:
    """Trust the dead reckoning less from now on."""
    d = drift.distance(s.lift)
    lift = drift.widen(s.lift, (SPREAD * d) ** 2, p.loose)
    return Seeking(
        s.accepted,
        p.loose,
        s.mode,
        s.since_s,
        s.agreed,
        s.nearest_m,
        s.motion,
        s.heard,
        lift,
        s.fix,
        s.manner,
    )


def afresh(s: Seeking, noise: Noise) -> Seeking:
    """Forget the target, and look for it again without trusting the dead reckoning."""
    h = s.heard
    heard = Heard(0, h.recent, 0.0, 0.0, h.range_m, h.dh_m, h.sigma_dh_m)
    return Seeking(s.accepted, noise, GATHER, 0.0, 0.0, s.nearest_m, s.motion, heard, s.lift, s.fix, s.manner)


def knowledge(p: SeekParameters, s: Seeking) -> Knowledge:
    """Distance, bearing and their sigmas, as read out last; during the search those of the posterior."""
    if s.mode == GATHER or (s.mode == SEARCH and s.agreed == 0.0):
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    q, m = s.fix, s.motion
    x, y = q.x - m.x - q.wx * m.dt_s, q.y - m.y - q.wy * m.dt_s
    d = math.hypot(x, y) + drift.TINY
    hx, hy = math.cos(m.heading), math.sin(m.heading)
    theta = model.wrap(math.atan2(hy * x - hx * y, hx * x + hy * y))
    if s.mode == SEARCH:
        sigma_d = math.sqrt(max(s.lift.p00, 0.0)) / max(d, NEAR_RANGE_M)
        return Knowledge(d, theta, sigma_d, min(math.sqrt(-2.0 * math.log(s.agreed)), math.pi))
    ux, uy = x / d, y / d
    along = ux * ux * q.xx + 2.0 * ux * uy * q.xy + uy * uy * q.yy
    across = uy * uy * q.xx - 2.0 * ux * uy * q.xy + ux * ux * q.yy
    # as long as the dead reckoning is trusted, the filter leaves out most of the drift that may be there
    drift_m_s = p.loose.drift_m_s if s.noise.drift_m_s < p.loose.drift_m_s else 0.0
    sigma_theta = math.hypot(math.sqrt(max(across, 0.0)) / max(d, 0.3), drift_m_s / p.v)
    return Knowledge(d, theta, math.sqrt(max(along, 0.0)), min(sigma_theta, math.pi))
