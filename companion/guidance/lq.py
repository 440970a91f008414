"""The steering laws: the paper's LQ law, Eq. (8) to (14), and an LQ law on the bearing error.

Both gains are closed forms, of the order of a microsecond each, so that no solver and no table flies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.guidance.model import NEAR_M, jacobian


class Gains(NamedTuple):
    """The row K of a state feedback ω = −K x."""

    k1: float
    k2: float


def paper_gains(d_m: float, theta_rad: float, v_m_s: float, q1: float, q2: float, r: float) -> Gains:
    """Eq. (10), Eq. (11), in the loop Eq. (13), Eq. (14): the gains that minimise Eq. (8), at (d̂, θ̂).

    Eq. (8) is ½∫(xᵀ Q x + r ω²) dt with Q = diag(q1, q2), x = [d, θ].

    Erratum: Eq. (11) and Eq. (14) are printed in the filter's (transposed) form. The regulator needs
    AᵀP + P A − P B r⁻¹ Bᵀ P + Q = 0; as printed, k1 has the wrong sign near sin θ = 0 and drives θ away
    from 0. With A from `jacobian` the regulator's equation has the solution below, its root chosen for
    stability: near sin θ = 0 the gain k1 jumps between ±√(q1/r), which makes the law a relay there.
    """
    m = jacobian(d_m, theta_rad, v_m_s)
    k1 = -m.b + math.copysign(math.sqrt(m.b * m.b + q1 / r), m.a)
    k2 = m.c + math.sqrt(m.c * m.c + 2.0 * m.a * k1 + q2 / r)
    return Gains(k1, k2)


def paper_yaw_rate(d_m: float, theta_rad: float, k: Gains) -> float:
    """Eq. (9), with estimates Eq. (12): ω = −K x̂, not yet limited.

    Erratum: x is no error; d = 0 cannot be held at constant speed, so the infinite integral of Eq. (8) has
    no finite value and the law is a heuristic. It steers all the same.
    """
    return -k.k1 * d_m - k.k2 * theta_rad


def bearing_gains(d_m: float, v_m_s: float, lag_s: float, q1: float, q2: float, r: float) -> Gains:
    """LQ gains on the state [θ, actual yaw rate], at bearing 0 and distance d.

    A = [[v/d, 1], [0, −1/τ]], B = [0, 1/τ], Q = diag(q1, q2): the yaw rate follows its command with a
    first-order lag τ ≥ 0. By spectral factorisation: p(s) p(−s) = a(s) a(−s) + (what Q weighs)/r has four
    roots symmetric to both axes, and the coefficients of p = s² + p1 s + p0 follow from two square roots.
    Everything is multiplied by τ, so that τ = 0 needs no case of its own.
    """
    a = v_m_s / (d_m if d_m > NEAR_M else NEAR_M)
    p0 = math.sqrt(a * a + (q1 + q2 * a * a) / r)
    p1 = math.sqrt(2.0 * p0 * lag_s + a * a * lag_s * lag_s + 1.0 + q2 / r)
    k2 = p1 + a * lag_s - 1.0
    return Gains(p0 + a * (1.0 + k2), k2)


def bearing_yaw_rate(theta_rad: float, yaw_rate_rad_s: float, k: Gains) -> float:
    """ω = −k1 θ̂ − k2 (yaw rate measured now), not yet limited."""
    return -k.k1 * theta_rad - k.k2 * yaw_rate_rad_s
