"""The Kalman filter against the textbook in matrices, and against the truth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance import kalman, model
from companion.guidance.kalman import Gaussian, Measured
from companion.guidance.model import Lifted

RATES = st.floats(-1.5, 1.5)
ENTRIES = st.lists(st.floats(-3.0, 3.0), min_size=9, max_size=9)


def _belief(x: list[float], root: list[float]) -> tuple[Gaussian, Any, Any]:
    """A belief with an arbitrary proper covariance, and the same as arrays."""
    r = np.reshape(root, (3, 3))
    p = r @ r.T + 0.01 * np.eye(3)
    g = Gaussian(Lifted(*x), p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2])
    return g, np.array(x), p


def _matrix(g: Gaussian) -> Any:
    return np.array([[g.p11, g.p12, g.p13], [g.p12, g.p22, g.p23], [g.p13, g.p23, g.p33]])


@given(
    x=st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3), root=ENTRIES, v=RATES, w=RATES, omega=RATES
)
def test_prediction_is_the_textbooks(
    x: list[float], root: list[float], v: float, w: float, omega: float
) -> None:
    dt, q, q_turn = 0.05, 1e-3, 2e-3
    g, mean, p = _belief(x, root)
    half, turn = 0.5 * omega * dt, omega * dt
    forward = (v * math.cos(half) - w * math.sin(half)) * dt
    left = (v * math.sin(half) + w * math.cos(half)) * dt
    shift = np.array([[1.0, left, -forward], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    c, s = math.cos(turn), math.sin(turn)
    f = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ shift
    constant = np.array([0.5 * (forward**2 + left**2), c * left - s * forward, -s * left - c * forward])
    mean = f @ mean + constant
    across = np.array([0.0, mean[2], -mean[1]])
    p = f @ p @ f.T + dt * (q * np.diag([0.0, 1.0, 1.0]) + q_turn * np.outer(across, across))
    got = kalman.predict(g, model.step(dt, v, w, omega), dt, q, q_turn)
    assert got.x == pytest.approx(tuple(mean), abs=1e-9)
    assert _matrix(got) == pytest.approx(p, rel=1e-9, abs=1e-9)


@given(
    x=st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3),
    root=ENTRIES,
    y=st.floats(-10.0, 200.0),
    variance=st.floats(1e-6, 100.0),
)
def test_update_is_the_textbooks(x: list[float], root: list[float], y: float, variance: float) -> None:
    g, mean, p = _belief(x, root)
    h = np.array([1.0, 0.0, 0.0])
    k = p @ h / (h @ p @ h + variance)
    joseph = np.eye(3) - np.outer(k, h)
    got = kalman.update(g, Measured(y, variance))
    assert got.x == pytest.approx(tuple(mean + k * (y - mean[0])), rel=1e-7, abs=1e-7)
    assert _matrix(got) == pytest.approx(
        joseph @ p @ joseph.T + variance * np.outer(k, k), rel=1e-6, abs=1e-7
    )


@pytest.mark.parametrize(("d", "height"), [(0.3, 0.0), (10.0, 0.0), (0.3, 5.0), (10.0, 5.0)])
def test_measurement_has_the_mean_and_variance_that_it_claims(d: float, height: float) -> None:
    rng = np.random.default_rng(1)
    sigma, sigma_h, n = 0.3, 0.05, 200_000
    r = math.hypot(d, height)
    z = r + rng.normal(0.0, sigma, n)
    dh = height + rng.normal(0.0, sigma_h, n)
    y = np.array([kalman.measured(a, sigma, b, sigma_h, r).y for a, b in zip(z[:20_000], dh, strict=False)])
    claimed = kalman.measured(r, sigma, height, sigma_h, r).variance
    # the height's own square shifts the mean by σ_h²/2, which is left out: it is no noise from range to range
    assert np.mean(y) == pytest.approx(0.5 * (d * d - sigma_h**2), abs=5.0 * math.sqrt(claimed / len(y)))
    assert np.var(y) == pytest.approx(claimed, rel=0.05)


def test_at_the_start_every_bearing_is_possible() -> None:
    g = kalman.start(kalman.measured(10.0, 0.07, 0.0, 0.0, 10.0))
    assert model.distance(g.x) == pytest.approx(10.0, abs=0.01)
    assert kalman.bearing_sigma(g, 10.0) > 1.5
    assert g.p22 == g.p33 == pytest.approx(50.0, rel=0.05)


def test_overhead_the_belief_stays_proper() -> None:
    g = kalman.start(kalman.measured(4.8, 0.07, 5.0, 0.1, 4.8))
    for n in range(200):
        g = kalman.predict(g, model.step(0.05, 0.5, 0.0, 0.3), 0.05, 1e-3, 1e-3)
        g = kalman.update(g, kalman.measured(4.7 + 0.002 * n, 0.07, 5.0, 0.1, 4.8))
        assert np.all(np.linalg.eigvalsh(_matrix(g)) > -1e-9)
        assert 0.0 < kalman.distance_sigma(g, model.distance(g.x)) < 5.0


def test_bearing_sigma_tells_the_truth() -> None:
    """Circling with exact motion, the bearing's error is one sigma in size, and within two in nine of ten."""
    rng = np.random.default_rng(3)
    scores = []
    for _ in range(300):
        truth = model.lift(float(rng.uniform(3.0, 20.0)), float(rng.uniform(-3.1, 3.1)))
        m = model.step(0.05, 0.5, 0.0, float(rng.choice([-0.6, 0.6])))
        g = None
        for _ in range(100):
            d = model.distance(truth)
            y = kalman.measured(d + float(rng.normal(0.0, 0.07)), 0.07, 0.0, 0.0, d)
            g = kalman.start(Measured(y.y, 2.0 * y.variance)) if g is None else kalman.update(g, y)
            truth = model.flow(truth, m)
            g = kalman.predict(g, m, 0.05, 1e-9, 1e-9)
        assert g is not None
        error = model.wrap(model.bearing(g.x) - model.bearing(truth))
        scores.append(error / kalman.bearing_sigma(g, model.distance(g.x)))
    assert np.mean(np.abs(scores) < 2.0) > 0.9
    assert 0.7 < float(np.sqrt(np.mean(np.square(scores)))) < 1.3
