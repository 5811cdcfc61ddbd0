"""Normal distributions in Cholesky form with analytic gradients, for SPDRL. Float64 throughout.

A distribution is N(mean, L L^T) with L lower triangular and positive on its diagonal. As parameters it is one vector:
(mean, log diag L, the entries below the diagonal, row by row).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from space_dist.curricula.interface import FloatArray


@dataclass(frozen=True)
class Gaussian:
    """mean: (d,).  factor: (d, d) lower triangular, the Cholesky factor of the covariance."""

    mean: FloatArray
    factor: FloatArray

    @classmethod
    def of(cls, mean: FloatArray, std: FloatArray) -> Gaussian:
        """Independent features: (d,) means and standard deviations."""
        return cls(np.array(mean, dtype=np.float64), np.diag(np.array(std, dtype=np.float64)))

    @classmethod
    def from_parameters(cls, parameters: FloatArray) -> Gaussian:
        """The inverse of `parameters`."""
        d = dimension(len(parameters))
        factor = np.diag(np.exp(parameters[d : 2 * d]))
        factor[np.tril_indices(d, -1)] = parameters[2 * d :]
        return cls(parameters[:d].copy(), factor)

    @property
    def parameters(self) -> FloatArray:
        """`(d (d + 3) / 2,)`."""
        below = self.factor[np.tril_indices(len(self.mean), -1)]
        return np.concatenate([self.mean, np.log(np.diag(self.factor)), below])

    def seen_from(self, other: Gaussian) -> Gaussian:
        """The same distribution in the coordinates in which `other` is the standard normal one."""
        mean = solve_triangular(other.factor, self.mean - other.mean, lower=True)
        return Gaussian(mean, solve_triangular(other.factor, self.factor, lower=True))

    def back_from(self, other: Gaussian) -> Gaussian:
        """The inverse of `seen_from`."""
        return Gaussian(other.mean + other.factor @ self.mean, other.factor @ self.factor)

    @property
    def std(self) -> FloatArray:
        """`(d,)` standard deviations of the features."""
        deviations: FloatArray = np.sqrt((self.factor**2).sum(axis=1))
        return deviations

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """`(count, d)`."""
        return self.mean + random.standard_normal((count, len(self.mean))) @ self.factor.T

    def log_density(self, points: FloatArray) -> FloatArray:
        """`(m,)` of (m, d) points."""
        whitened = solve_triangular(self.factor, (points - self.mean).T, lower=True)
        constant = 0.5 * len(self.mean) * np.log(2.0 * np.pi) + np.log(np.diag(self.factor)).sum()
        density: FloatArray = -0.5 * (whitened**2).sum(axis=0) - constant
        return density

    def log_density_gradient(self, points: FloatArray, weights: FloatArray) -> FloatArray:
        """Gradient, by the parameters, of the sum over j of weights_j * log density of point j."""
        whitened = solve_triangular(self.factor, (points - self.mean).T, lower=True)  # (d, m)
        back = solve_triangular(self.factor, whitened, lower=True, trans="T")
        by_factor = (back * weights) @ whitened.T
        return self._gradient(back @ weights, by_factor, -float(weights.sum()))

    def kl_to(self, other: Gaussian) -> float:
        """KL(self || other)."""
        ratio = solve_triangular(other.factor, self.factor, lower=True)
        gap = solve_triangular(other.factor, other.mean - self.mean, lower=True)
        logs = np.log(np.diag(other.factor)).sum() - np.log(np.diag(self.factor)).sum()
        return float(0.5 * ((ratio**2).sum() + gap @ gap - len(self.mean)) + logs)

    def kl_to_gradient(self, other: Gaussian) -> FloatArray:
        """Gradient of KL(self || other) by the parameters of self."""

        def precise(values: FloatArray) -> FloatArray:
            half = solve_triangular(other.factor, values, lower=True)
            whole: FloatArray = solve_triangular(other.factor, half, lower=True, trans="T")
            return whole

        return self._gradient(precise(self.mean - other.mean), precise(self.factor), -1.0)

    def kl_from_gradient(self, other: Gaussian) -> FloatArray:
        """Gradient of KL(other || self) by the parameters of self."""
        ratio = solve_triangular(self.factor, other.factor, lower=True)
        gap = solve_triangular(self.factor, self.mean - other.mean, lower=True)
        spread = ratio @ ratio.T + np.outer(gap, gap)
        by_factor = -solve_triangular(self.factor, spread, lower=True, trans="T")
        return self._gradient(solve_triangular(self.factor, gap, lower=True, trans="T"), by_factor, 1.0)

    def fisher(self) -> FloatArray:
        """`(p, p)` the Hessian, by the parameters of p at p = self, of KL(self || p).

        With B = L^-1 dL it is the form of KL = |L^-1 d mean|^2 / 2 + (|B|^2 + sum_i B_ii^2) / 2 to second order.
        """
        d = len(self.mean)
        size = len(self.parameters)
        moved = np.zeros((size, d * d))  # B for a unit change of each parameter
        rows, columns = np.tril_indices(d, -1)
        diagonal = np.diag(self.factor)
        rows, columns = np.append(np.arange(d), rows), np.append(np.arange(d), columns)
        for place in range(len(rows)):
            change = np.zeros((d, d))
            change[rows[place], columns[place]] = diagonal[place] if place < d else 1.0
            moved[d + place] = solve_triangular(self.factor, change, lower=True).ravel()
        diagonals = moved[:, :: d + 1]
        form: FloatArray = moved @ moved.T + diagonals @ diagonals.T
        inverse = solve_triangular(self.factor, np.eye(d), lower=True)
        form[:d, :d] = inverse.T @ inverse
        return form

    def _gradient(self, by_mean: FloatArray, by_factor: FloatArray, by_log_determinant: float) -> FloatArray:
        """From gradients by mean and L, and by sum log diag L, to one by the parameters."""
        by_log_diagonal = np.diag(by_factor) * np.diag(self.factor) + by_log_determinant
        return np.concatenate([by_mean, by_log_diagonal, by_factor[np.tril_indices(len(self.mean), -1)]])


def dimension(size: int) -> int:
    """The d of a vector of d (d + 3) / 2 parameters."""
    return (math.isqrt(9 + 8 * size) - 3) // 2
