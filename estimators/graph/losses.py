"""Losses: what a residual costs, and the weight that iteratively reweighted least squares gives it.

A loss rho(x) of a residual x in standard deviations has the weight rho'(x) / x. The kernels hold the same
functions compiled; those here say what they are, and the tests compare the two.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from estimators.messages import FloatArray


class LossKind(IntEnum):
    """Shape of a loss."""

    GAUSSIAN = 0
    HUBER = 1
    CAUCHY = 2
    ONE_SIDED = 3
    """Cauchy where more was measured than predicted, Gaussian elsewhere: what blocks a range lengthens it."""


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss.

    Attributes:
        kind: its shape.
        scale: residual, in standard deviations, beyond which it differs from the Gaussian.
    """

    kind: LossKind
    scale: float = 1.0

    def value(self, residual: FloatArray) -> FloatArray:
        """Loss of residuals (N,) in standard deviations, measured minus predicted."""
        square, size, k = residual**2, np.abs(residual), self.scale
        gaussian = 0.5 * square
        cauchy = 0.5 * k * k * np.log1p(square / k**2)
        if self.kind is LossKind.HUBER:
            return np.where(size > k, k * (size - 0.5 * k), gaussian)
        if self.kind is LossKind.CAUCHY:
            return np.asarray(cauchy)
        if self.kind is LossKind.ONE_SIDED:
            return np.where(residual > 0.0, cauchy, gaussian)
        return np.asarray(gaussian)

    def weight(self, residual: FloatArray) -> FloatArray:
        """Weight of residuals (N,) in standard deviations: derivative of the loss over the residual."""
        square, size, k = residual**2, np.abs(residual), self.scale
        ones = np.ones_like(residual)
        cauchy = 1.0 / (1.0 + square / k**2)
        if self.kind is LossKind.HUBER:
            return np.where(size > k, k / np.maximum(size, k), ones)
        if self.kind is LossKind.CAUCHY:
            return np.asarray(cauchy)
        if self.kind is LossKind.ONE_SIDED:
            return np.where(residual > 0.0, cauchy, ones)
        return ones


GAUSSIAN = Loss(LossKind.GAUSSIAN)
