"""Ranges against the pose that the LiDAR carried on: those that are too long, and anchors that gave such."""

from math import exp, log, tanh, tau

from scipy.special import log_ndtr

BLOCKED_SHARE = 0.1
"""Share of ranges that are blocked when nothing is known of a place."""
PRIOR = log(BLOCKED_SHARE / (1.0 - BLOCKED_SHARE))
"""The same as log-odds."""
_FURTHEST = 8.0
"""Sigmas from the prediction beyond which a residual says no more."""
_SUREST = 20.0
"""Greatest log-odds that are kept: more is not told from certainty by floating point."""
_LOG_ROOT_TAU = 0.5 * log(tau)


class Prediction:
    """Remembers of every anchor how likely it is blocked, and lets residuals change that.

    Whether an anchor is blocked is a Markov chain with two states: what stands in the way stays for a while,
    and so does a clear view.

    Args:
        memory: time constant with which the chain forgets [s].

    Source: two-state Markov chain, Thrun, Burgard and Fox, Probabilistic Robotics, 4.2.
    """

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self.reset()

    def reset(self) -> None:
        """Know nothing of any anchor."""
        self._known: dict[int, tuple[int, float]] = {}

    def prior(self, anchor_id: int, stamp_ns: int) -> float:
        """Log-odds of an anchor being blocked, before its range is looked at."""
        if anchor_id not in self._known:
            return PRIOR
        last_ns, log_odds = self._known[anchor_id]
        kept = exp(-max(stamp_ns - last_ns, 0) * 1e-9 / self._memory)
        share = BLOCKED_SHARE + kept * (probability(log_odds) - BLOCKED_SHARE)
        return log(share / (1.0 - share))

    def remember(self, anchor_id: int, stamp_ns: int, log_odds: float) -> None:
        """Keep what is now known of an anchor: log-odds after its residual was looked at."""
        self._known[anchor_id] = stamp_ns, min(max(log_odds, -_SUREST), _SUREST)


def excess_log_ratio(residual: float, sigma: float, excess: float) -> float:
    """How much a residual speaks for a blocked range, whose excess is exponentially distributed.

    Args:
        residual: measured minus predicted range [m].
        sigma: its standard deviation [m] when nothing is blocked, that of the prediction included.
        excess: mean of what a blocked range is too long by [m].

    Source: huang2024, NLOS rejection against the pose derived from the LiDAR; in place of its threshold the
    likelihood ratio of exponentially modified Gaussian and Gaussian.
    """
    scaled = min(max(residual / sigma, -_FURTHEST), _FURTHEST)
    decay = sigma / excess
    blocked = log(decay) + 0.5 * decay**2 - decay * scaled + float(log_ndtr(scaled - decay))
    return blocked + 0.5 * scaled**2 + _LOG_ROOT_TAU


def probability(log_odds: float) -> float:
    """Probability of what has these log-odds."""
    return 0.5 * (1.0 + tanh(0.5 * log_odds))
