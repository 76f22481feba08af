"""The Levenberg-Marquardt solver with bounds."""

import numpy as np

from ballu_mjx.identification.bounded_solver import bounded_least_squares


def silent(step: int, steps: int, loss: float) -> None:
    """Ignore the progress of a search."""


def test_solver_finds_the_minimum_of_a_curved_valley():
    goal = np.array([0.7, 0.49])

    def valley(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = np.array([30 * (x[1] - x[0] ** 2), goal[0] - x[0]])
        return values, np.array([[-60 * x[0], 30.0], [-1.0, 0.0]])

    found, loss = bounded_least_squares(valley, np.array([0.05, 0.95]), 60, silent, 10)
    np.testing.assert_allclose(found, goal, atol=1e-5)
    assert loss < 1e-9


def test_solver_leaves_a_bound_that_an_early_step_reached():
    """A search whose first step ends on a bound still finds the minimum in the interior. In logistic coordinates, it
    would stay at the bound, where their derivative is 0."""
    seen: list[np.ndarray] = []

    def bent(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(x)
        # The derivative at the start is a tenth of that farther on, so the first step is ten times too long.
        return np.array([np.tanh(8 * (x[0] - 0.4))]), np.array([[8 / np.cosh(8 * (x[0] - 0.4)) ** 2]])

    found, _ = bounded_least_squares(bent, np.array([0.65]), 40, silent, 10)
    assert any(x[0] == 0.0 for x in seen)
    np.testing.assert_allclose(found, 0.4, atol=1e-5)


def test_solver_minimizes_along_a_bound_that_excludes_the_minimum():
    matrix, goal = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([1.5, 0.3])
    found, _ = bounded_least_squares(lambda x: (matrix @ (x - goal), matrix), np.array([0.5, 0.5]), 20, silent, 5)
    along = np.linspace(0, 1, 100_001)
    best = np.argmin([np.sum((matrix @ (np.array([1.0, y]) - goal)) ** 2) for y in along[::100]])
    np.testing.assert_allclose(found, [1.0, along[::100][best]], atol=1e-3)
