"""What an estimator made of ranges whose true excess is known: blocked ones refused, clean ones kept."""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from estimators.base import Report, Verdict
from estimators.messages import FloatArray, RangeFrame

BIASED_SIGMAS = 3.0
"""A range counts as biased when what stands between made it too long by more than this many sigmas."""
_JUDGED = frozenset(Verdict) - {
    Verdict.UNKNOWN_ANCHOR,
    Verdict.IMPOSSIBLE,
    Verdict.TOO_FEW,
    Verdict.LATE,
    Verdict.WAITING,
    Verdict.AMBIGUOUS,
    Verdict.NOT_USED,
}


@dataclass(slots=True)
class RangeScore:
    """Ranges on which an estimator gave a verdict; those with a small bias count as neither.

    Attributes:
        biased: number of ranges that are too long by more than `BIASED_SIGMAS`.
        biased_rejected: of these, not used at all.
        biased_downweighted: of these, used with less weight.
        clean: number of ranges in line of sight.
        clean_rejected: of these, not used at all.
        clean_downweighted: of these, used with less weight.
    """

    biased: int = 0
    biased_rejected: int = 0
    biased_downweighted: int = 0
    clean: int = 0
    clean_rejected: int = 0
    clean_downweighted: int = 0

    def note(self, excess: FloatArray, sigma: float, report: Report) -> None:
        """Count one frame.

        Args:
            excess: (N,) of its ranges [m]; NaN where it is not known.
            sigma: standard deviation of a range [m].
            report: with N verdicts.
        """
        for one, verdict in zip(excess.tolist(), report.verdicts, strict=True):
            if verdict not in _JUDGED:
                continue
            weakened = verdict is Verdict.DOWNWEIGHTED
            rejected = not verdict.is_used
            if one > BIASED_SIGMAS * sigma:
                self.biased += 1
                self.biased_rejected += rejected
                self.biased_downweighted += weakened
            elif one == 0.0:
                self.clean += 1
                self.clean_rejected += rejected
                self.clean_downweighted += weakened


class TrueExcess:
    """By how much every range of a simulated walk is too long.

    Args:
        period: time between two frames [s].
    """

    def __init__(self, period: float) -> None:
        self._tolerance_ns = round(0.5e9 * period)
        self._stamps_ns: list[int] = []
        self._excess: list[dict[int, float]] = []

    def note(self, stamp_ns: int, excess: dict[int, float]) -> None:
        """Take the excess [m] by anchor of one frame; frames come in stamp order."""
        self._stamps_ns.append(stamp_ns)
        self._excess.append(excess)

    def of(self, frame: RangeFrame) -> FloatArray:
        """Excess (N,) [m] of a frame's ranges, whose stamp may err a little; NaN where it is not known."""
        after = bisect_left(self._stamps_ns, frame.stamp_ns)
        near = [k for k in (after - 1, after) if 0 <= k < len(self._stamps_ns)]
        nearest = min(near, key=lambda k: abs(self._stamps_ns[k] - frame.stamp_ns), default=None)
        if nearest is None or abs(self._stamps_ns[nearest] - frame.stamp_ns) > self._tolerance_ns:
            return np.full(len(frame.ranges), np.nan)
        known = self._excess[nearest]
        return np.array([known.get(anchor_id, np.nan) for anchor_id in frame.anchor_ids.tolist()])


def pooled(scores: Iterable[RangeScore]) -> dict[str, float | int | None]:
    """Counts and shares over several trials; a share of nothing is None."""
    total = RangeScore()
    for score in scores:
        for name in RangeScore.__dataclass_fields__:
            setattr(total, name, getattr(total, name) + getattr(score, name))

    def share(part: int, whole: int) -> float | None:
        return part / whole if whole else None

    return {
        "biased": total.biased,
        "biased_rejected": share(total.biased_rejected, total.biased),
        "biased_downweighted": share(total.biased_downweighted, total.biased),
        "clean": total.clean,
        "clean_rejected": share(total.clean_rejected, total.clean),
        "clean_downweighted": share(total.clean_downweighted, total.clean),
    }
