"""The paper's observer, Eq. (23) to (26): three poles at −λ, gains that divide by the yaw rate.

Kept as published. The characteristic polynomial is right at every instant, but the error system Eq. (34) is
time-varying, and frozen eigenvalues do not make it stable, as the proof of Theorem 1 has it: under the yaw
rates that the paper's own law produces it is marginal or unstable for small λ. Started from a true bearing
with a small λ it is dead reckoning, and works; started from a wrong one it takes long or never recovers.
"""

from __future__ import annotations

import math

from companion.guidance.model import Lifted, clip

CORRECTION_MAX_S = 0.2
"""After a gap the correction counts for no more than this, which keeps the discrete observer stable."""
BOUND = 1e6
"""Nothing grows beyond this (m, m²): where the observer diverges, its numbers stay finite."""


def gains(omega_rad_s: float, v_m_s: float, pole_rad_s: float, omega_floor_rad_s: float) -> Lifted:
    """Eq. (24), Eq. (25): K_o(ω), which gives Ā − K_o Cᵀ the polynomial (s + λ)³, λ = `pole_rad_s` > 0.

    K_o2 has 1/ω in it, and where ω = 0 there is no such gain. Below the floor |ω| counts as the floor (with
    its sign), and the poles are then not at −λ.
    """
    w = math.copysign(max(abs(omega_rad_s), omega_floor_rad_s), omega_rad_s)
    k = pole_rad_s
    return Lifted(
        3.0 * k,
        (k * k * k - 3.0 * k * w * w) / (v_m_s * w),
        (w * w - 3.0 * k * k) / v_m_s,
    )


def correct(x: Lifted, k: Lifted, y_o: float, since_s: float) -> Lifted:
    """Eq. (23): the correction K_o (y_o − Cᵀ x̂) over the time since the last one.

    The rest of Eq. (23), Ā x̂ + δ, is `model.flow`.
    """
    push = (y_o - x.x1) * min(since_s, CORRECTION_MAX_S)
    return Lifted(
        clip(x.x1 + k.x1 * push, BOUND), clip(x.x2 + k.x2 * push, BOUND), clip(x.x3 + k.x3 * push, BOUND)
    )
