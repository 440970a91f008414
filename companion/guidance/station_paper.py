"""Station keeping as the paper has it, Eq. (37) to (48): steer by the beacon whose distance is most wrong.

One Luenberger observer per beacon; an LQ law with an integral state on the beacon of the largest |e_i|. Kept
as published, apart from its errata; what flies is `companion.guidance.station`. Even with the true state it
does not stay: it stops where it may and it cannot come back in a straight line. With its observer few of its
stops are truly inside ε, as max|e_i| ≤ ε bounds the position only through the beacons' geometry.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.guidance import luenberger, model
from companion.guidance.model import Lifted
from companion.guidance.scheme import PROBE, STAY, TRACK, UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_settings import StationSettings

PARALLEL_M_S = 1e-3
"""|a| counts as at least this much (m/s): at sin θ = 0 the yaw rate cannot move d, and no solution exists."""

FAR = 2.0
"""What has stopped is told to have left when a distance is wrong by this many ε."""


class IntegralGains(NamedTuple):
    """The row K_cs of ω = −K_cs [d, θ, w]."""

    k1: float
    k2: float
    k3: float


def integral_gains(d_m: float, theta_rad: float, v_m_s: float, q: float, r: float) -> IntegralGains:
    """Eq. (47) with the solution of Eq. (48), at (d̂, θ̂), for Q_cs = diag(0, 0, q) and r_cs = r.

    The model is Eq. (44): A_a = [[A, 0], [−1 0, 0]] with A of Eq. (17), B_a = [0, 1, 0].

    Errata: Eq. (48) is printed in the filter's (transposed) form, which has no stabilising solution; the
    regulator's is A_aᵀ P + P A_a − P B_a r⁻¹ B_aᵀ P + Q_cs = 0. By spectral factorisation, X = s²:
    X³ + (2ab − c²) X² + a² b² X − (q/r) a² = 0 holds at the squared poles; the stable ones are −√X, and K_cs
    follows from their polynomial s³ + p2 s² + p1 s + p0.
    """
    m = model.jacobian(d_m, theta_rad, v_m_s)
    a = math.copysign(max(abs(m.a), PARALLEL_M_S), m.a)
    d = max(d_m, model.NEAR_M)
    b = a / (d * d)
    p2, p1, p0 = _stable(2.0 * a * b - m.c * m.c, a * a * b * b, -q / r * a * a)
    return IntegralGains(p1 / a - b, p2 + m.c, -p0 / a)


def _stable(c2: float, c1: float, c0: float) -> tuple[float, float, float]:
    """p2, p1, p0 of ∏(s + √X_i) over the roots X_i of X³ + c2 X² + c1 X + c0, c0 < 0, Re √X_i > 0."""
    # a positive root lies between 0, where the polynomial is c0 < 0, and Fujiwara's bound: Newton's method,
    # halving the interval where that leads out of it
    low, high = 0.0, 2.0 * max(abs(c2), math.sqrt(abs(c1)), abs(c0) ** (1.0 / 3.0))
    x = high
    for _ in range(200):
        f = ((x + c2) * x + c1) * x + c0
        if f > 0.0:
            high = x
        else:
            low = x
        slope = (3.0 * x + 2.0 * c2) * x + c1
        after = x - f / slope if slope > 0.0 else low
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - x) <= 1e-16 * x:
            break
        x = after
    # the other two: X² + u X + g, with square roots z, z' : z z' = √g, (z + z')² = 2 √g − u
    z = math.sqrt(x)
    u = c2 + x
    product = math.sqrt(max(-c0 / x, 0.0))
    total = math.sqrt(max(2.0 * product - u, 0.0))
    return z + total, z * total + product, z * product


class Parameters(NamedTuple):
    """The scheme's constants; SI units, ε and d* in metres."""

    distances: tuple[float, ...]
    v: float
    omega_max: float
    radius: float
    pole: float
    omega_floor: float
    q: float
    r: float
    integral_max: float
    bearings: tuple[float, ...]


class BeaconObserver(NamedTuple):
    """Eq. (37), Eq. (43): one beacon's [d, θ, w]: lifted estimate, distance as measured, integral of e."""

    x: Lifted
    is_seen: bool
    d_m: float
    sigma_m: float
    integral: float
    since_s: float


class PaperStation(NamedTuple):
    """State: an observer per beacon, the yaw rate seen last, and whether the vehicle has come to stop.

    `stays` does not fly anything: it keeps what people are told from changing with the noise of a range.
    """

    accepted: float
    beacons: tuple[BeaconObserver, ...]
    omega_rad_s: float
    stays: bool


def initial(p: Parameters) -> PaperStation:
    """No range yet."""
    nothing = BeaconObserver(Lifted(0.0, 0.0, 0.0), False, 0.0, 0.0, 0.0, 0.0)
    return PaperStation(0.0, (nothing,) * len(p.distances), 0.0, False)


def predict(
    p: Parameters, s: PaperStation, dt_s: float, forward_m_s: float, left_m_s: float, yaw_rate_rad_s: float
) -> PaperStation:
    """Eq. (35), Eq. (36), in state-space form Eq. (38), for every beacon, in the lift; and ẇ = e.

    Erratum: Eq. (36) takes θ_i in [0, 2π), which tears the feedback apart at θ = 0; (−π, π] is used.
    """
    m = model.step(dt_s, forward_m_s, left_m_s, yaw_rate_rad_s)
    beacons = []
    for b, d_star in zip(s.beacons, p.distances, strict=True):
        if b.is_seen:
            w = model.clip(b.integral + error(d_star, b.d_m) * dt_s, p.integral_max)
            b = BeaconObserver(model.flow(b.x, m), True, b.d_m, b.sigma_m, w, b.since_s + dt_s)
        beacons.append(b)
    return PaperStation(s.accepted, tuple(beacons), yaw_rate_rad_s, s.stays)


def error(d_star_m: float, d_m: float) -> float:
    """Eq. (40): e_i = d_i* − d_i.

    Erratum: with ẇ = e the augmented model is affine, Eq. (41): d* enters ẇ, and the gain ignores it.
    """
    return d_star_m - d_m


def update(
    p: Parameters,
    s: PaperStation,
    beacon: int,
    range_m: float,
    sigma_m: float,
    dh_m: float,
    sigma_dh_m: float,
) -> PaperStation:
    """One slant range: the output Eq. (39), Eq. (42) is d_i as measured; the observer of Eq. (23) corrects θ.

    Every range is believed, as in the paper; below the height it counts as d = 0.
    """
    b = s.beacons[beacon]
    y_o = max(model.lifted_range(range_m, dh_m), 0.0)
    d = math.sqrt(2.0 * y_o)
    sigma_d = math.hypot(range_m * sigma_m, dh_m * sigma_dh_m) / max(d, model.NEAR_M)
    if not b.is_seen:
        x = model.lift(d, p.bearings[beacon]) if p.bearings else Lifted(y_o, 0.0, 0.0)
    else:
        k = luenberger.gains(s.omega_rad_s, p.v, p.pole, p.omega_floor)
        x = luenberger.correct(b.x, k, y_o, b.since_s)
    b = BeaconObserver(x, True, d, sigma_d, b.integral, 0.0)
    beacons = (*s.beacons[:beacon], b, *s.beacons[beacon + 1 :])
    return PaperStation(1.0, beacons, s.omega_rad_s, s.stays)


def steer(p: Parameters, d_m: float, theta_rad: float, integral: float) -> float:
    """Eq. (46): ω = −K_cs x̂_a, limited to ω̄; K_cs minimises Eq. (45).

    Errata: in Eq. (45) a scalar e_i meets a 3×3 matrix Q_cs; with the paper's Q_cs = diag(0, 0, 0.1) the
    integral alone is weighed. Eq. (43) is a column.
    """
    k = integral_gains(d_m, theta_rad, p.v, p.q, p.r)
    return model.clip(-k.k1 * d_m - k.k2 * theta_rad - k.k3 * integral, p.omega_max)


def command(
    p: Parameters, s: PaperStation, dt_s: float, yaw_rate_rad_s: float
) -> tuple[PaperStation, Command]:
    """Steer by the beacon of the largest |e_i|, and stop while all |e_i| ≤ ε."""
    if not all(b.is_seen for b in s.beacons):
        return s, Command(0.0, 0.0, PROBE)
    b = s.beacons[_worst(p, s)]
    worst = max(abs(error(d, b.d_m)) for b, d in zip(s.beacons, p.distances, strict=True))
    stays = worst <= (FAR * p.radius if s.stays else p.radius)
    s = PaperStation(s.accepted, s.beacons, s.omega_rad_s, stays)
    if worst <= p.radius:
        return s, Command(0.0, 0.0, STAY)
    omega = steer(p, b.d_m, model.bearing(b.x), b.integral)
    return s, Command(p.v, omega, STAY if stays else TRACK)


def _worst(p: Parameters, s: PaperStation) -> int:
    errors = [abs(error(d, b.d_m)) for b, d in zip(s.beacons, p.distances, strict=True)]
    return errors.index(max(errors))


def knowledge(p: Parameters, s: PaperStation) -> Knowledge:
    """There is no estimate of the station: the beacon steered by now is told, bearing sigma π."""
    if not all(b.is_seen for b in s.beacons):
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    b = s.beacons[_worst(p, s)]
    return Knowledge(b.d_m, model.bearing(b.x), b.sigma_m, math.pi)


def station_paper(
    distances_m: tuple[float, ...],
    speed_m_s: float,
    yaw_rate_max_rad_s: float,
    radius_m: float,
    *,
    pole_rad_s: float = 0.2,
    yaw_rate_floor_rad_s: float = 0.02,
    q: float = 0.1,
    r: float = 100.0,
    integral_max_m_s: float = 1e3,
    bearings_rad: tuple[float, ...] = (),
) -> Scheme:
    """The paper's scheme for the station at these distances from the beacons, in the order of their numbers.

    `q`, `r`: Q_cs = diag(0, 0, q) and r_cs of Eq. (45); `pole_rad_s`: λ of Eq. (25); `bearings_rad`: the
    beacons' bearings at the start, which the paper takes as known (none: not known).
    """
    p = Parameters(
        distances_m,
        speed_m_s,
        yaw_rate_max_rad_s,
        radius_m,
        pole_rad_s,
        yaw_rate_floor_rad_s,
        q,
        r,
        integral_max_m_s,
        bearings_rad,
    )
    return Scheme(p, initial, predict, update, command, knowledge)


def from_settings(
    settings: GuidanceSettings,
    keeping: StationSettings,
    distances_m: tuple[float, ...],
    bearings_rad: tuple[float, ...],
) -> Scheme:
    """The paper's scheme as configured, see `station_paper`."""
    return station_paper(
        distances_m,
        settings.speed_m_s,
        settings.yaw_rate_max_rad_s,
        keeping.radius_m,
        pole_rad_s=settings.luenberger_pole_rad_s,
        yaw_rate_floor_rad_s=settings.luenberger_yaw_rate_floor_rad_s,
        q=keeping.paper_q,
        r=keeping.paper_r,
        bearings_rad=bearings_rad,
    )
