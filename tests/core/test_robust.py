"""The surrogate's weights, against the cases of the paper and their limits."""

import math

import numpy as np

from segslam.core.robust import tls_weights


def test_tls_weights_are_the_three_cases_of_the_paper() -> None:
    bound, control = 0.2, 0.5
    squared = np.array([0.0, control / (control + 1) * bound**2, bound**2, (control + 1) / control * bound**2, 9.0])
    middle = math.sqrt(control * (control + 1)) - control
    assert np.allclose(tls_weights(squared, control, bound**2), [1.0, 1.0, middle, 0.0, 0.0])


def test_graduated_weights_lie_between_least_squares_and_the_cut() -> None:
    squared = np.array([0.0, 0.5, 1.0, 2.0, 50.0])
    np.testing.assert_allclose(tls_weights(squared, 1e6, 1.0), [1.0, 1.0, 0.5, 0.0, 0.0], atol=1e-6)
    nearly_convex = tls_weights(squared, 1e-3, 1.0)
    assert (np.diff(nearly_convex) <= 0.0).all()
    assert nearly_convex[-1] > 0.0, "at first no residual has weight 0"
