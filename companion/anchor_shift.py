"""Whether an anchor stands elsewhere than the site file says: from what its ranges miss all along."""

from dataclasses import dataclass, field

import numpy as np

from estimators.messages import FloatArray, IntArray

SPACING_NS = 100_000_000
"""Ranges of an anchor nearer to each other than this say the same."""
LEAST_SHIFT = 0.15
"""A shorter shift [m] is left to a survey (`companion smooth --anchors`)."""
LEAST_RANGES, LEAST_SPAN = 50, 5.0
"""Ranges, and seconds, that a shift must explain."""
LEAST_SPREAD = 0.05
"""Least eigenvalue of the mean of u u': seen from one direction, a shift and a bias look alike."""
EXPLAINED = 0.5
"""What is left of the mean absolute residual when a shift is the cause."""
_BEGINNINGS = 30
_ROUNDS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """An anchor's place, seen from where the site file has it.

    Attributes:
        stamp_ns: since when.
        shift: (2,) [m], map frame.
        before: mean absolute residual since then [m].
        after: the same with the anchor there [m].
    """

    stamp_ns: int
    shift: FloatArray
    before: float
    after: float


@dataclass(slots=True)
class RangeMisses:
    """Residuals of one anchor with the directions in which it was seen.

    Attributes:
        stamps_ns: of the ranges kept.
        residuals: measured minus predicted [m].
        directions: unit vectors from the anchor to the tag, map frame.
    """

    stamps_ns: list[int] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    directions: list[FloatArray] = field(default_factory=list)

    def add(self, stamp_ns: int, residual: float, anchor_to_tag: FloatArray) -> None:
        """Take a range with a residual [m] and the vector (2,) [m] from anchor to tag."""
        if self.stamps_ns and stamp_ns - self.stamps_ns[-1] < SPACING_NS:
            return
        distance = float(np.hypot(*anchor_to_tag))
        if np.isfinite(residual) and distance > 0.0:
            self.stamps_ns.append(stamp_ns)
            self.residuals.append(residual)
            self.directions.append(anchor_to_tag / distance)

    def shift(self) -> Shift | None:
        """The shift that explains the residuals from some time on; None where none does.

        A shift d changes a range by ``-u d``; what blocks a range only lengthens it, for a while, and a bias
        changes it by the same everywhere. So the shift must explain all ranges up to the end, and better
        than any bias.
        """
        if len(self.residuals) < LEAST_RANGES:
            return None
        stamps_ns = np.array(self.stamps_ns, dtype=np.int64)
        residuals, directions = np.array(self.residuals), np.array(self.directions)
        last = len(residuals) - LEAST_RANGES
        begins = np.unique(np.linspace(0, last, _BEGINNINGS).astype(np.int64))
        shifts = [_least_absolute(directions[i:], residuals[i:]) for i in begins]
        costs = [
            np.abs(residuals[:i]).sum() + np.abs(residuals[i:] + directions[i:] @ shift).sum()
            for i, shift in zip(begins, shifts, strict=True)
        ]
        best = int(np.argmin(costs))
        return _explains(stamps_ns, residuals, directions, int(begins[best]), shifts[best])


def _explains(
    stamps_ns: IntArray, residuals: FloatArray, directions: FloatArray, begin: int, shift: FloatArray
) -> Shift | None:
    stamps_ns, residuals, directions = stamps_ns[begin:], residuals[begin:], directions[begin:]
    before = float(np.abs(residuals).mean())
    after = float(np.abs(residuals + directions @ shift).mean())
    by_bias = float(np.abs(residuals - np.median(residuals)).mean())
    spread = float(np.linalg.eigvalsh(directions.T @ directions / len(directions))[0])
    is_shift = (
        (stamps_ns[-1] - stamps_ns[0]) * 1e-9 >= LEAST_SPAN
        and float(np.hypot(*shift)) >= LEAST_SHIFT
        and spread >= LEAST_SPREAD
        and after < EXPLAINED * before
        and after < by_bias
    )
    return Shift(int(stamps_ns[0]), shift, before, after) if is_shift else None


def _least_absolute(directions: FloatArray, residuals: FloatArray) -> FloatArray:
    """The d, (2,), with the least sum of ``|r + u d|``: blocked ranges weigh no more than they must."""
    shift: FloatArray = np.zeros(2)
    for _ in range(_ROUNDS):
        weights = 1.0 / np.maximum(np.abs(residuals + directions @ shift), 1e-3)
        normal = (directions * weights[:, None]).T @ directions + 1e-9 * np.eye(2)
        shift = np.linalg.solve(normal, -(directions * weights[:, None]).T @ residuals).astype(np.float64)
    return shift
