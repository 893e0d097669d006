"""Losses: weights as derivatives, the kernel's the same, what blocks a range loses its weight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.graph.losses import Loss, LossKind
from estimators.kernels import factors as kernels

EVERY_LOSS = pytest.mark.parametrize("kind", list(LossKind))
scales = st.floats(0.3, 5.0)


@EVERY_LOSS
@given(st.floats(-20.0, 20.0), scales)
def test_the_weight_is_the_derivative_over_the_residual(
    kind: LossKind, residual: float, scale: float
) -> None:
    loss, step = Loss(kind, scale), 1e-5
    ahead, behind = loss.value(np.array([residual + step, residual - step]))
    weight = loss.weight(np.array([residual]))[0]
    assert weight * residual == pytest.approx((ahead - behind) / (2 * step), abs=1e-4)


@EVERY_LOSS
@given(st.floats(-20.0, 20.0), scales)
def test_the_kernel_has_the_same_losses(kind: LossKind, residual: float, scale: float) -> None:
    loss, at = Loss(kind, scale), np.array([residual])
    value, weight = kernels.loss(float(kind), scale, residual**2, residual)
    assert value == pytest.approx(loss.value(at)[0], rel=1e-12, abs=1e-15)
    assert weight == pytest.approx(loss.weight(at)[0], rel=1e-12)


def test_only_a_range_that_is_too_long_loses_weight_in_the_one_sided_loss() -> None:
    weights = Loss(LossKind.ONE_SIDED, 2.0).weight(np.array([-6.0, -0.1, 0.0, 2.0, 6.0]))
    np.testing.assert_allclose(weights, [1.0, 1.0, 1.0, 0.5, 0.1])
