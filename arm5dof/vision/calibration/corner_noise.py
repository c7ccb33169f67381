"""How the errors of one photograph's corners hang together, by what is left of them where the board's pose fits best.

Blur, light, a board that is not quite flat and what the lens model lacks move neighbouring corners alike: of OpenCV's
photographs errors of neighbours correlate by 0.33 and 0.38, along the rows and down the columns. As if independent they
would tell the camera's pose two to three times better than they do.
"""

from __future__ import annotations

import numpy as np

LENGTHS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Over how many squares the correlation may fall to 1/e. Beforehand each is as probable as the others, and that there
is none as probable as all of them together."""


def corner_covariance(points: np.ndarray, residual: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """The covariance of the corners' errors.

    It falls off exponentially with the distance on the board, alike for x and y. Over what length, residuals tell by
    their restricted likelihood (Patterson and Thompson, Biometrika 58, 1971), which allows for what the fit has taken
    from them: the most probable counts.

    Args:
        points: The n corners in the board's frame, (n, 3), metres.
        residual: What separates them from where they were seen, (2n,), pixels.
        jacobian: Its derivative by the p numbers that were fitted, (2n, p).

    Returns:
        (2n, 2n), square pixels.
    """
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    square = apart[apart > 0].min()
    correlations = [np.eye(len(points)), *(np.exp(-apart / (length * square)) for length in LENGTHS)]
    found = [_restricted_likelihood(residual, jacobian, correlation) for correlation in correlations]
    log_probability, variance = np.transpose(found)
    log_probability[0] += np.log(len(LENGTHS))
    best = log_probability.argmax()
    return np.kron(variance[best] * correlations[best], np.eye(2))


def _restricted_likelihood(residual: np.ndarray, jacobian: np.ndarray, correlation: np.ndarray) -> tuple[float, float]:
    """The logarithm of residuals' restricted likelihood with a correlation (n, n), and the most likely variance."""
    n = len(correlation)
    root = np.linalg.cholesky(correlation)
    both = np.concatenate([residual[:, None], jacobian], axis=1)
    white = np.linalg.solve(root, both.reshape(n, -1)).reshape(both.shape)
    basis, triangle = np.linalg.qr(white[:, 1:])
    rest = white[:, 0] - basis @ (basis.T @ white[:, 0])
    spare = len(rest) - jacobian.shape[1]
    variance = max(rest @ rest / spare, np.finfo(float).tiny)
    determinants = 2 * np.log(np.diag(root)).sum() + np.log(np.abs(np.diag(triangle))).sum()
    return -determinants - spare / 2 * np.log(variance), variance
