"""The mock's noise is Python's, number for number: flights recorded before stay what they were."""

from random import Random

from sitl_mock.noise import Noise


def test_the_noise_is_that_of_pythons_random() -> None:
    ours, pythons = Noise("7/uwb/b1"), Random("7/uwb/b1")
    for _ in range(50):
        assert ours.random() == pythons.random()
        assert ours.gauss(0.07) == pythons.gauss(0.0, 0.07)
        assert ours.uniform(0.5, 4.0) == pythons.uniform(0.5, 4.0)
        assert ours.gauss(1.0) == pythons.gauss(0.0, 1.0)
        assert ours.gauss(0.5) == pythons.gauss(0.0, 0.5)
