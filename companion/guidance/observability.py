"""What the distance tells of the bearing: Eq. (32), Eq. (33) and the rank of the observability matrix."""

from __future__ import annotations

Row = tuple[float, float, float]


def observability_matrix(v_m_s: float, omega_rad_s: float) -> tuple[Row, Row, Row, Row, Row]:
    """Eq. (32), Eq. (33): gradients of y_o and its first four Lie derivatives along Eq. (21).

    Erratum: with L⁰ = x1 and L¹ = −v x3, the next ones are L² = v² + v ω x2, L³ = v ω² x3 and
    L⁴ = −v² ω² − v ω³ x2. The constant of L² is printed as 2 v², L³ and L⁴ each lack a factor ω, and with
    them rows 4 and 5 of Eq. (33), which are [0, 0, v ω²] and [0, −v ω³, 0].
    """
    v, w = v_m_s, omega_rad_s
    return (
        (1.0, 0.0, 0.0),
        (0.0, 0.0, -v),
        (0.0, v * w, 0.0),
        (0.0, 0.0, v * w * w),
        (0.0, -v * w * w * w, 0.0),
    )


def rank(v_m_s: float, omega_rad_s: float) -> int:
    """Rank of Eq. (33): 3 while moving and turning, 2 while moving straight, 1 at rest.

    Rank 2 does not mean that nothing is known: x1 and x3 follow from the range and its rate, hence |x2|
    from x1 = (x2² + x3²)/2. Only the side, the sign of θ, is lost, and it is remembered from the last turn.
    That is Proposition 1; how well the bearing is known in flight is `kalman.bearing_sigma`.
    """
    if v_m_s == 0.0:
        return 1
    return 2 if omega_rad_s == 0.0 else 3
