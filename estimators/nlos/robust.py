"""One-sided robust likelihood: a range that may be blocked counts less instead of being rejected."""

from estimators.nlos.prediction import probability

_GREATEST = 100.0
"""A sigma that is so many times larger leaves nothing of a range."""


def sigma_factor(log_odds: float) -> float:
    """How many times larger the sigma of a range has to be when it may be blocked.

    The likelihood is a mixture: Gaussian when the range is clear, and with an exponential tail to the long
    side when it is blocked. Its slope is about that of the Gaussian times the probability that it is clear.

    Args:
        log_odds: of the range being blocked.

    Source: Huber and Ronchetti, Robust Statistics, 2009, 7.8 (weights); slope of a mixture: Dempster, Laird
    and Rubin, J. Royal Statistical Society B 39(1), 1977 (expectation step).
    """
    clear = max(1.0 - probability(log_odds), _GREATEST**-2)
    factor: float = clear**-0.5
    return factor
