"""How much residuals and powers of ranges speak for blocked ones, and how long that is remembered.

What every function says is a log-likelihood ratio or log-odds, see `estimators.nlos`.
"""

from math import erfc, exp, isfinite, log, log1p, sqrt, tanh, tau

import numpy as np

from estimators.kernels.compilation import INDICES, VECTOR, compiled
from estimators.messages import FloatArray, IntArray

BLOCKED_SHARE = 0.1
"""Share of ranges that are blocked when nothing is known of a place."""
PRIOR = log(BLOCKED_SHARE / (1.0 - BLOCKED_SHARE))
"""The same as log-odds."""
LIKELY = log(10.0)
"""How much the vendor's "likely" says."""
NEVER = np.iinfo(np.int64).min
"""Stamp [ns] of what has not happened."""
_HALF_WIDTH = 2.0
"""From the middle between both marks of the vendor's rule to each of them [dB]."""
_FURTHEST = 8.0
"""Sigmas from the prediction beyond which a residual says no more."""
_SUREST = 20.0
"""Greatest log-odds that are kept: more is not told from certainty by floating point."""
_GREATEST = 100.0
"""A sigma that is so many times larger leaves nothing of a range."""
_TAIL = -30.0
"""Below this `erfc` comes near the smallest numbers; the series of the tail is right to 1e-12 there."""
_LOG_ROOT_TAU = 0.5 * log(tau)


@compiled("float64(float64)")
def probability(log_odds: float) -> float:
    """Probability of what has these log-odds."""
    return 0.5 * (1.0 + tanh(0.5 * log_odds))


@compiled(f"float64({INDICES}, {VECTOR}, int64, int64, float64)")
def prior(known_ns: IntArray, known: FloatArray, anchor: int, stamp_ns: int, memory: float) -> float:
    """Log-odds of an anchor being blocked, before its range is looked at.

    Whether an anchor is blocked is a Markov chain with two states: what stands in the way stays for a while,
    and so does a clear view.

    Args:
        known_ns: (A,) when each anchor's range was last looked at, or `NEVER`.
        known: (A,) log-odds after that.
        anchor: number of the anchor.
        stamp_ns: of the range.
        memory: time constant with which the chain forgets [s].

    Source: two-state Markov chain, Thrun, Burgard and Fox, Probabilistic Robotics, 4.2.
    """
    if known_ns[anchor] == NEVER:
        return PRIOR
    kept = exp(-max(stamp_ns - known_ns[anchor], 0) * 1e-9 / memory)
    share = BLOCKED_SHARE + kept * (probability(known[anchor]) - BLOCKED_SHARE)
    return log(share / (1.0 - share))


@compiled(f"void({INDICES}, {VECTOR}, int64, int64, float64)")
def remember(known_ns: IntArray, known: FloatArray, anchor: int, stamp_ns: int, log_odds: float) -> None:
    """Keep what is now known of an anchor, in place: log-odds after its residual was looked at."""
    known_ns[anchor] = stamp_ns
    known[anchor] = min(max(log_odds, -_SUREST), _SUREST)


@compiled("float64(float64)")
def log_normal_share(x: float) -> float:
    """Logarithm of the standard normal distribution function.

    Source: Abramowitz and Stegun 26.2.29, its relation to the error function, and 26.2.12 for the tail.
    """
    if x > 0.0:
        return log1p(-0.5 * erfc(x * sqrt(0.5)))
    if x > _TAIL:
        return log(0.5 * erfc(-x * sqrt(0.5)))
    small = 1.0 / (x * x)
    series = 1.0 - small * (1.0 - 3.0 * small * (1.0 - 5.0 * small))
    return -0.5 * x * x - log(-x) - _LOG_ROOT_TAU + log(series)


@compiled("float64(float64, float64, float64)")
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
    blocked = log(decay) + 0.5 * decay**2 - decay * scaled + log_normal_share(scaled - decay)
    return blocked + 0.5 * scaled**2 + _LOG_ROOT_TAU


@compiled("float64(float64, float64, float64)")
def power_log_ratio(rx_power: float, fp_power: float, middle: float) -> float:
    """How much the powers of a range speak for a blocked one; nothing when there are none.

    What is blocked loses most on its first path.

    Args:
        rx_power: of everything received [dBm].
        fp_power: of the first path [dBm].
        middle: difference that says nothing [dB].

    Source: LinkTrack user manual: a difference below 6 dB makes line of sight likely, one above 10 dB makes a
    blocked range or multipath likely. Likely is taken for ten to one; it gets no likelier beyond the marks.
    """
    difference = rx_power - fp_power
    if not isfinite(difference):
        return 0.0
    return LIKELY * min(max((difference - middle) / _HALF_WIDTH, -1.0), 1.0)


@compiled("float64(float64)")
def sigma_factor(log_odds: float) -> float:
    """How many times larger the sigma of a range has to be when it may be blocked.

    The likelihood is a mixture: Gaussian when the range is clear, and with an exponential tail to the long
    side when it is blocked. Its slope is about that of the Gaussian times the probability that it is clear.

    Args:
        log_odds: of the range being blocked.

    Source: Huber and Ronchetti, Robust Statistics, 2009, 7.8 (weights); slope of a mixture: Dempster, Laird
    and Rubin, J. Royal Statistical Society B 39(1), 1977 (expectation step).
    """
    return float(max(1.0 - probability(log_odds), _GREATEST**-2) ** -0.5)
