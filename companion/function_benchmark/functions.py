"""The test functions of huang2024 Table 1 and what the paper reports of them in Table 2."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimators.messages import FloatArray

DIMENSIONS, POPULATION, ITERATIONS = 30, 30, 200
"""huang2024 section 3.1."""


@dataclass(frozen=True)
class BenchmarkFunction:
    """A function whose least value is 0, at the origin.

    Attributes:
        label: for tables and pictures.
        half_range: each coordinate is between minus and plus this.
        cost: values (n,) of points (n, dim).
    """

    label: str
    half_range: float
    cost: Callable[[FloatArray], FloatArray]


def _sphere(x: FloatArray) -> FloatArray:
    return np.asarray((x**2).sum(axis=1))


def _schwefel(x: FloatArray) -> FloatArray:
    return np.asarray(np.abs(x).sum(axis=1) + np.abs(x).prod(axis=1))


def _step(x: FloatArray) -> FloatArray:
    return np.asarray((np.floor(x + 0.5) ** 2).sum(axis=1))


def _rastrigin(x: FloatArray) -> FloatArray:
    return np.asarray((x**2 - 10.0 * np.cos(2.0 * np.pi * x) + 10.0).sum(axis=1))


def _griewank(x: FloatArray) -> FloatArray:
    ripples = np.cos(x / np.sqrt(np.arange(1, x.shape[1] + 1))).prod(axis=1)
    return np.asarray((x**2).sum(axis=1) / 4000.0 - ripples + 1.0)


FUNCTIONS = {
    "sphere": BenchmarkFunction("sphere", 100.0, _sphere),
    "schwefel": BenchmarkFunction("Schwefel 2.22", 10.0, _schwefel),
    "step": BenchmarkFunction("step", 100.0, _step),
    "rastrigin": BenchmarkFunction("Rastrigin", 5.12, _rastrigin),
    "griewank": BenchmarkFunction("Griewank", 600.0, _griewank),
}
"""huang2024 Table 1."""


class Printed(NamedTuple):
    """One entry of huang2024 Table 2.

    Attributes:
        mean: of the least values of 30 runs.
        std: as the paper calls it; nearly all are larger than the mean, like a root mean square.
        seconds: of one run.
    """

    mean: float
    std: float
    seconds: float


def _row(*entries: tuple[float, float, float]) -> dict[str, Printed]:
    return dict(zip(FUNCTIONS, (Printed(*entry) for entry in entries), strict=True))


PAPER = {
    "BAS": _row(
        (1.61e4, 1.65e4, 0.012),
        (2.34e2, 3.96e2, 0.014),
        (1.70e4, 1.73e4, 0.010),
        (2.39e2, 2.40e2, 0.013),
        (2.23e2, 2.26e2, 0.014),
    ),
    "IBAS": _row(
        (6.78e-16, 1.42e-15, 0.131),
        (1.25e-8, 1.47e-8, 0.129),
        (1.62e-1, 1.71e-1, 0.129),
        (3.10e-10, 3.21e-10, 0.132),
        (5.77e-10, 8.47e-10, 0.135),
    ),
    "PSO": _row(
        (1.31e2, 1.34e2, 0.161),
        (2.70, 2.80, 0.160),
        (1.35e2, 1.39e2, 0.164),
        (3.83e1, 3.91e1, 0.164),
        (2.47, 2.50, 0.171),
    ),
    "GA": _row(
        (1.13e4, 1.17e4, 0.103),
        (6.40e1, 8.33e1, 0.103),
        (1.06e4, 1.10e4, 0.105),
        (1.01e2, 1.02e2, 0.107),
        (1.12e2, 1.16e2, 0.109),
    ),
    "BA": _row(
        (1.55e3, 1.20e3, 0.213),
        (1.11, 2.22, 0.217),
        (1.35e3, 1.57e3, 0.217),
        (1.83e1, 1.94e1, 0.218),
        (5.17e1, 5.64e1, 0.226),
    ),
}
"""huang2024 Table 2: algorithm -> function -> entry."""
