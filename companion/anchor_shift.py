"""Whether an anchor stands elsewhere than the site file says: from what all ranges together miss.

A wrong anchor pulls the pose along, so residuals alone do not tell whose fault they are. In each short bin of
time the pose may be wrong by any e: of n anchors' residuals, what no e explains is left, n - 2 numbers, and a
shift of one anchor must explain these, in every bin.
"""

from math import hypot, isfinite
from statistics import median

import numpy as np

from estimators.immutable import immutable
from estimators.messages import FloatArray

BIN_NS = 500_000_000
"""Ranges within this time share one error of the pose."""
LEAST_ANCHORS = 4
"""With three, one number is left in a bin: too little to say which anchor it is."""
LEAST_SHIFT = 0.15
"""A shorter shift [m] is left to a survey (`companion smooth --anchors`)."""
LEAST_BINS = 10
"""A shift must explain so many bins, up to the last."""
LEAST_SPREAD = 0.005
"""Least eigenvalue of what a shift does in a bin, on average: seen from one side, a shift is a bias."""
EXPLAINED = 0.5
"""What a shift leaves of the misses."""
NOISY = 2.0
"""What is left may be so many times the noise, in every third of the time."""
SCATTERED = 2.0
"""An anchor whose ranges scatter so many times as much as the others' is blocked, wherever it stands."""
_BEGINNINGS = 20
_ROUNDS = 15


@immutable
class Shift:
    """An anchor's place, seen from where the site file has it.

    Attributes:
        anchor_id: which.
        stamp_ns: since when.
        shift: (2,) [m], map frame.
        bias: of all its ranges [m], where that explains them as well as a shift; else None.
        before: median of what the ranges miss, once the best pose is put to them [m].
        after: the same with the anchor there [m].
    """

    anchor_id: int
    stamp_ns: int
    shift: FloatArray
    bias: float | None
    before: float
    after: float


@immutable
class _Bin:
    """What no pose explains: misses (n,) [m], and for each anchor what a shift of it would change, (n, 2).

    Besides, how much the ranges of each anchor scatter: their median absolute deviation [m].
    """

    stamp_ns: int
    misses: FloatArray
    changes: dict[int, FloatArray]
    biases: dict[int, FloatArray]
    scatter: dict[int, float]


class RangeMisses:
    """Residuals of all anchors with the directions in which they were seen."""

    def __init__(self) -> None:
        self._bins: list[_Bin] = []
        self._begin_ns: int | None = None
        self._residuals: dict[int, list[float]] = {}
        self._directions: dict[int, tuple[float, float]] = {}

    def add(self, stamp_ns: int, anchor_id: int, residual: float, dx: float, dy: float) -> None:
        """Take a range with its residual [m] and the vector [m] from anchor to tag."""
        if self._begin_ns is None or stamp_ns - self._begin_ns >= BIN_NS:
            self._close_bin()
            self._begin_ns = stamp_ns
        distance = hypot(dx, dy)
        if isfinite(residual) and distance > 0.0:
            self._residuals.setdefault(anchor_id, []).append(residual)
            self._directions[anchor_id] = dx / distance, dy / distance

    def shift(self) -> Shift | None:
        """The shift of one anchor that explains the misses from some time on; None where none does."""
        self._close_bin()
        last = len(self._bins) - LEAST_BINS
        if last < 0:
            return None
        misses = [float(np.abs(b.misses).sum()) for b in self._bins]
        best: tuple[float, int, int, FloatArray] | None = None
        for begin in np.unique(np.linspace(0, last, _BEGINNINGS).astype(np.int64)).tolist():
            for anchor_id in sorted({i for b in self._bins[begin:] for i in b.changes}):
                y, change, _ = self._stacked(begin, anchor_id)
                shift = _least_absolute(change, y)
                cost = sum(misses[:begin]) + float(np.abs(y - change @ shift).sum())
                if best is None or cost < best[0]:
                    best = cost, anchor_id, begin, shift
        return None if best is None else self._judged(*best[1:])

    def _close_bin(self) -> None:
        ids = sorted(self._residuals)
        if self._begin_ns is not None and len(ids) >= LEAST_ANCHORS:
            # NumPy takes ten times as long for so few.
            middles = {i: median(self._residuals[i]) for i in ids}
            residuals = np.array(list(middles.values()))
            scatter = {i: median(abs(r - middles[i]) for r in self._residuals[i]) for i in ids}
            directions = np.array([self._directions[i] for i in ids])
            # An error e of the pose changes residuals by -u e: what is orthogonal to that is left.
            free = np.eye(len(ids)) - directions @ np.linalg.pinv(directions)
            changes = {i: -np.outer(free[:, k], directions[k]) for k, i in enumerate(ids)}
            biases = {i: free[:, k] for k, i in enumerate(ids)}
            self._bins.append(_Bin(self._begin_ns, free @ residuals, changes, biases, scatter))
        self._residuals = {}

    def _stacked(self, begin: int, anchor_id: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Misses (N,), changes (N, 2) by a shift and (N, 1) by a bias of an anchor, since a bin."""
        bins = self._bins[begin:]
        y = np.concatenate([b.misses for b in bins])
        change = np.vstack([b.changes.get(anchor_id, np.zeros((len(b.misses), 2))) for b in bins])
        bias = np.concatenate([b.biases.get(anchor_id, np.zeros(len(b.misses))) for b in bins])
        return y, change, bias[:, None]

    def _judged(self, anchor_id: int, begin: int, shift: FloatArray) -> Shift | None:
        y, change, bias = self._stacked(begin, anchor_id)
        left = y - change @ shift
        before, after = float(np.median(np.abs(y))), float(np.median(np.abs(left)))
        spread = float(np.linalg.eigvalsh(change.T @ change / (len(self._bins) - begin))[0])
        noise = self._noise(begin)
        constant = _least_absolute(bias, y)
        is_shift = (
            float(np.hypot(*shift)) >= LEAST_SHIFT
            and spread >= LEAST_SPREAD
            and after < EXPLAINED * before
            and _is_noise(left, noise)
            and not self._is_scattered(begin, anchor_id)
        )
        if not is_shift:
            return None
        is_bias = _is_noise(y - bias @ constant, noise)
        since_ns = self._bins[begin].stamp_ns
        return Shift(anchor_id, since_ns, shift, float(constant[0]) if is_bias else None, before, after)

    def _is_scattered(self, begin: int, anchor_id: int) -> bool:
        """Whether an anchor's ranges scatter far more than the others' since a bin."""
        its = [b.scatter[anchor_id] for b in self._bins[begin:] if anchor_id in b.scatter]
        others = [s for b in self._bins[begin:] for i, s in b.scatter.items() if i != anchor_id]
        return float(np.median(its)) > SCATTERED * float(np.median(others))

    def _noise(self, begin: int) -> float:
        """Median absolute noise of a miss [m]: from bin to bin neither a shift nor a bias changes much."""
        pairs = zip(self._bins[begin:-1], self._bins[begin + 1 :], strict=True)
        steps = [np.abs(b.misses - a.misses) for a, b in pairs if len(a.misses) == len(b.misses)]
        return float(np.median(np.concatenate(steps))) / np.sqrt(2.0) if steps else 0.0


def _is_noise(left: FloatArray, noise: float) -> bool:
    """Whether in every third of the time little more is left than the median absolute noise [m]."""
    return all(float(np.median(np.abs(third))) <= NOISY * noise for third in np.array_split(left, 3))


def _least_absolute(A: FloatArray, y: FloatArray) -> FloatArray:
    """The x with the least sum of ``|y - A x|``: blocked ranges weigh no more than they must."""
    x: FloatArray = np.zeros(A.shape[1])
    for _ in range(_ROUNDS):
        weights = 1.0 / np.maximum(np.abs(y - A @ x), 1e-3)
        weighted = A * weights[:, None]
        x = np.asarray(np.linalg.solve(weighted.T @ A + 1e-9 * np.eye(len(x)), weighted.T @ y))
    return x
