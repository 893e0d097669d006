"""The solvers of li2022 as estimators: linear least squares, gradient descent, momentum gradient descent."""

from pydantic import Field

from estimators.base import Setup
from estimators.messages import FloatArray
from estimators.uwb.frame_solver import FrameSolver
from estimators.uwb.position_solvers import Solution, closed_form, gradient_descent, momentum_descent


class LinearLeastSquares(FrameSolver):
    """Closed form on squared ranges: no iteration, but a range that is too long weighs with its square.

    Source: li2022, "least squares"; huang2024 Eq. (4).
    """

    class Config(FrameSolver.Config):
        """Settings of `linear_ls`."""

    def _solve(self, anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:  # noqa: ARG002
        return Solution(closed_form(anchors, ranges), 0)


class _Descent(FrameSolver):
    """Solver that iterates from the closed form in the plane."""

    class Config(FrameSolver.Config):
        """Settings of every descent."""

        tolerance: float = Field(
            1e-8, gt=0, le=0.1, description="a descent ends where the gradient is smaller [m]"
        )
        max_iterations: int = Field(2000, ge=1, le=100_000, description="and after so many steps at most")


class GradientDescent(_Descent):
    """Gradient descent on the mean squared range residual, with a fixed step.

    Source: li2022, gradient descent.
    """

    class Config(_Descent.Config):
        """Settings of `gd`."""

        step: float = Field(0.5, gt=0, lt=1, description="factor of the gradient, stable below 1")

    def __init__(self, config: Config, setup: Setup) -> None:
        self._descend = gradient_descent(config.step, config.tolerance, config.max_iterations)
        super().__init__(config, setup)

    def _solve(self, anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:
        return self._descend(anchors, ranges, start)


class MomentumGradientDescent(_Descent):
    """Gradient descent with momentum and variable step: the same optimum in fewer steps.

    Source: li2022, improved momentum gradient descent.
    """

    class Config(_Descent.Config):
        """Settings of `momentum_gd`."""

        memory: float = Field(0.1, ge=0, lt=1, description="weight of the former gradients in the average")

    def __init__(self, config: Config, setup: Setup) -> None:
        self._descend = momentum_descent(config.memory, config.tolerance, config.max_iterations)
        super().__init__(config, setup)

    def _solve(self, anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:
        return self._descend(anchors, ranges, start)
