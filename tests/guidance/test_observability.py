"""The observability matrix against the powers of the system matrix."""

from __future__ import annotations

import numpy as np
import pytest

from companion.guidance import observability


@pytest.mark.parametrize("v", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("omega", [-1.0, 0.0, 0.3])
def test_rows_are_those_of_the_system_and_so_is_the_rank(v: float, omega: float) -> None:
    a = np.array([[0.0, 0.0, -v], [0.0, 0.0, omega], [0.0, -omega, 0.0]])
    expected = [np.linalg.matrix_power(a, n)[0] for n in range(5)]
    rows = np.array(observability.observability_matrix(v, omega))
    assert rows == pytest.approx(np.array(expected))
    assert observability.rank(v, omega) == np.linalg.matrix_rank(rows)
