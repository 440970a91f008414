"""Target capture with the lift of `drift`: what the observer "drift" does with ranges, and how it steers.

GATHER until there are five ranges; SEARCH with the bearing open, on its posterior; FOLLOW with the bearing
known. The frame is that of `drift`: dead-reckoned, the heading zero where guidance began.
"""

from __future__ import annotations

import math

import msgspec

from companion.guidance import drift, lq, model, readout
from companion.guidance.drift import DriftLift, Known, Noise
from companion.guidance.kalman import measured, median_of_five
from companion.guidance.readout import Fix
from companion.guidance.scheme import PROBE, REST, TRACK, UNKNOWN_M, Command, Knowledge

GATHER = 0
SEARCH = 1
FOLLOW = 2

FIRST_RANGES = 5
"""The filter starts from the median of this many ranges."""
REJECTION_MEMORY = 0.93
"""Forgetting factor, per range, of the average that starts a locked-out filter afresh."""
SURPRISE_MEMORY = 0.97
"""The same of the average innovation."""
SURPRISE_MAX = 0.5
"""An average innovation of so many sigmas says that the dead reckoning is wrong."""
SPREAD = 0.3
"""Then the target may be elsewhere by this share of its distance."""
NEAR_RANGE_M = 0.2
"""The noise of d²/2 is never taken for smaller than at this range."""
SMOOTHING_S = 0.15
"""The velocity that the vehicle coasts with is the mean over about this time: single moves may jump."""
AGREED = 0.9
"""The search ends where the resultant of the bearing's posterior is above this."""
TURN_ON = 0.88
"""Below this resultant the vehicle turns at the largest yaw rate."""
LOOK_AHEAD_S = 1.0
"""To which side: as if the bearing were known after this time."""
SEARCH_S = 6.0
"""The search ends after this time in any case; the read-out goes on correcting itself."""
RECEDES_M = 1.5
"""A target that is steered at and yet gets farther away by this much is looked for afresh."""
CRAB_MAX = 0.9
"""Largest sine of the crab angle."""
AIMED_RAD = 0.3
"""A turn on the spot ends where the target is this near to straight ahead."""
TURN_RAD = 0.5
"""And begins where it is this far off."""
PATIENCE_S = 30.0
"""Near the target the certainty that a stop asks for fades over this time: knowledge has its limits too."""


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
    lift, q = s.lift, s.fix
    if s.mode != GATHER:
        known = s.mode == FOLLOW
        lift = drift.predict(lift, s.noise, Known(q.x, q.y, q.wx, q.wy), known, m.dt_s, m.x, m.y)
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
    if heard.seen >= FIRST_RANGES:
        mode = SEARCH
        d = max(math.sqrt(max(2.0 * median_of_five(recent), 0.0)), 0.5)
        lift = drift.start(d, sigma_m * max(range_m / d, 1.0), s.noise)
    motion = Motion(m.heading, m.vx, m.vy, 0.0, 0.0, 0.0)
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
    sigma_theta = math.sqrt(max(across, 0.0)) / max(d, 0.3)
    return Knowledge(d, theta, math.sqrt(max(along, 0.0)), min(sigma_theta, math.pi))


# --------------------------------------------------------------------------------------------- commanding


def command(p: SeekParameters, s: Seeking, dt_s: float, yaw_rate_rad_s: float) -> tuple[Seeking, Command]:
    """Read the lift out, and steer by what it says."""
    if s.mode == GATHER:
        # a path begun with a well-known distance tells its bearing sooner
        return s, Command(0.0, 0.0, PROBE)
    s = caught_up(p, s)
    h = s.heard
    offset = h.range_m * p.offset
    height = h.dh_m * h.sigma_dh_m
    i = readout.information(s.lift, offset * offset + height * height)
    if s.mode == SEARCH:
        return search(p, s, i, yaw_rate_rad_s)
    q = readout.fix(s.lift, i, s.lift.x, s.lift.y)
    s = Seeking(
        s.accepted, s.noise, s.mode, s.since_s, s.agreed, s.nearest_m, s.motion, s.heard, s.lift, q, s.manner
    )
    return follow(p, s, dt_s, yaw_rate_rad_s)


def search(
    p: SeekParameters, s: Seeking, i: readout.Information, yaw_rate_rad_s: float
) -> tuple[Seeking, Command]:
    """Turn to the side of the shorter path while the directions disagree, then to their mean."""
    f, m = s.lift, s.motion
    d = max(drift.distance(f), NEAR_RANGE_M)
    weights = readout.posterior(f, i, d)
    open_ = readout.mean_direction(weights)
    hx, hy = math.cos(m.heading), math.sin(m.heading)
    theta = math.atan2(hy * open_.cos - hx * open_.sin, hx * open_.cos + hy * open_.sin)
    omega = yaw_rate(p, s.manner.turn, d, theta, 0.0, yaw_rate_rad_s)
    if s.since_s < p.search_turn_s + p.lag:
        omega = s.manner.turn * p.omega_max
    elif open_.resultant < TURN_ON:
        omega = p.omega_max * shorter_side(p, weights, m.heading, s.manner.turn, yaw_rate_rad_s)
    q = Fix(d * open_.cos, d * open_.sin, 0.0, 0.0, 0.0, 0.0, 0.0)
    mode, lift = SEARCH, f
    if open_.resultant > AGREED or s.since_s > SEARCH_S:
        mode = FOLLOW
        q = readout.fix(f, i, q.x, q.y)
        lift = drift.settle(f, q.x, q.y, q.xx + q.yy, s.noise)
    manner = Manner(side(omega, s.manner.turn), False, False, 0.0)
    agreed = max(open_.resultant, drift.TINY)
    s = Seeking(s.accepted, s.noise, mode, s.since_s, agreed, UNKNOWN_M, m, s.heard, lift, q, manner)
    return s, Command(p.v, omega, PROBE)


def shorter_side(
    p: SeekParameters, weights: list[float], heading_rad: float, turn: float, yaw_rate_rad_s: float
) -> float:
    """The side to turn to while the bearing is open: the shorter path on the mean, were the bearing known
    LOOK_AHEAD_S from now.

    Far from the target, a path is longer than the way that it gains towards it by ∫ v (1 − cos θ) dt: so
    much for turning to one side or the other until then, and R (|θ| − sin |θ|), with R = v/ω̄, for the
    shorter turn from there.
    """
    lag_s = p.lag * (1.0 - math.exp(-LOOK_AHEAD_S / p.lag)) if p.lag > 0.0 else 0.0
    coast_rad = yaw_rate_rad_s * lag_s
    turn_rad = turn * p.omega_max * (LOOK_AHEAD_S - lag_s)
    on_rad, back_rad = coast_rad + turn_rad, coast_rad - turn_rad
    difference = 0.0
    for k in range(readout.AZIMUTHS):
        left_rad = readout.AZIMUTH_RAD[k] - heading_rad
        difference += weights[k] * (excess_m(p, left_rad, on_rad) - excess_m(p, left_rad, back_rad))
    return turn if difference <= 0.0 else -turn


def excess_m(p: SeekParameters, left_rad: float, turned_rad: float) -> float:
    """How much longer the path becomes by a turn of LOOK_AHEAD_S, the target `left_rad` to the left."""
    after = abs(model.wrap(left_rad - turned_rad))
    # the mean of a cosine over an arc, to the second order
    ahead = math.cos(left_rad - 0.5 * turned_rad) * (1.0 - turned_rad * turned_rad / 24.0)
    return p.v * LOOK_AHEAD_S * (1.0 - ahead) + p.v / p.omega_max * (after - math.sin(after))


def follow(p: SeekParameters, s: Seeking, dt_s: float, yaw_rate_rad_s: float) -> tuple[Seeking, Command]:
    """Steer to the target against the drift, and stop where it will surely rest within the radius."""
    q, m, was = s.fix, s.motion, s.manner
    hx, hy = math.cos(m.heading), math.sin(m.heading)
    # the target as seen from where the vehicle would come to rest if it were stopped now
    ex = q.x - p.velocity_lag * m.vx
    ey = q.y - p.velocity_lag * m.vy
    rest_m = math.hypot(ex, ey)
    ahead = ex * hx + ey * hy
    aside = hy * ex - hx * ey
    sigma_m = math.sqrt(max(q.xx + q.yy, 0.0))
    near_s = was.near_s + dt_s if rest_m < 2.0 * p.radius else max(was.near_s - dt_s, 0.0)
    sure = p.stop_sigma * max(1.0 - (near_s / PATIENCE_S) ** 2, 0.0)
    if was.rests:
        rests = rest_m < 0.9 * p.radius
    else:
        arrived = rest_m < 0.3 * p.radius or was.stands or ahead < 0.0
        rests = arrived and rest_m + max(sure * sigma_m, 0.4 * p.radius) < p.radius
    if rests:
        manner = Manner(was.turn, True, False, near_s)
        return with_manner(s, manner), Command(0.0, 0.0, REST)
    # a target inside the turning circle cannot be reached by turning on: turn on the spot, or, while its
    # place is too uncertain for that, fly the circle, which tells it
    turning_radius = p.v / p.omega_max
    inside = math.hypot(ahead, abs(aside) - turning_radius) < turning_radius
    off = math.atan2(aside, ahead)
    if abs(off) > (AIMED_RAD if was.stands else TURN_RAD) and (inside or was.stands):
        if sure * sigma_m > 0.6 * p.radius:
            manner = Manner(was.turn, False, False, near_s)
            return with_manner(s, manner), Command(p.v, was.turn * p.omega_max, TRACK)
        omega = yaw_rate(p, was.turn, turning_radius, off, 0.0, yaw_rate_rad_s)
        manner = Manner(side(omega, was.turn), False, True, near_s)
        return with_manner(s, manner), Command(0.0, omega, TRACK)
    # the velocity follows the nose: aim from where it will have done so
    ax = ex + p.velocity_lag * p.v * hx
    ay = ey + p.velocity_lag * p.v * hy
    d = math.hypot(ax, ay) + drift.TINY
    theta = math.atan2(hy * ax - hx * ay, hx * ax + hy * ay)
    across = (ax * q.wy - ay * q.wx) / d
    crab = math.asin(model.clip(across / p.v, CRAB_MAX))
    omega = yaw_rate(p, was.turn, d, theta, crab, yaw_rate_rad_s)
    manner = Manner(side(omega, was.turn), False, False, near_s)
    return with_manner(s, manner), Command(p.v, omega, TRACK)


def yaw_rate(
    p: SeekParameters, turn: float, d_m: float, theta_rad: float, crab_rad: float, yaw_rate_rad_s: float
) -> float:
    """The yaw rate, within bounds, that brings the heading to `crab_rad` right of the target."""
    if p.paper_law:
        gains = lq.paper_gains(d_m, theta_rad, p.v, p.q1, p.q2, p.r)
        return model.clip(lq.paper_yaw_rate(d_m, theta_rad + crab_rad, gains), p.omega_max)
    error = model.wrap(theta_rad + crab_rad)
    if abs(error) > math.pi - p.turn_through and error * turn > 0.0:
        # almost straight astern, turning on is as near as turning back
        error -= math.copysign(2.0 * math.pi, error)
    gains = lq.bearing_gains(max(d_m, 0.5 * p.radius), p.v, p.lag, p.q1, p.q2, p.r)
    return model.clip(lq.bearing_yaw_rate(error, yaw_rate_rad_s, gains), p.omega_max)


def side(omega_rad_s: float, before: float) -> float:
    """+1.0 for a turn to the left, −1.0 to the right; flying straight on changes nothing."""
    return before if omega_rad_s == 0.0 else math.copysign(1.0, omega_rad_s)


def with_manner(s: Seeking, manner: Manner) -> Seeking:
    """The same state with another manner."""
    return Seeking(
        s.accepted,
        s.noise,
        s.mode,
        s.since_s,
        s.agreed,
        s.nearest_m,
        s.motion,
        s.heard,
        s.lift,
        s.fix,
        manner,
    )
