"""Signal powers: what is blocked loses most on its first path."""

from math import isfinite, log

LIKELY = log(10.0)
"""How much the vendor's "likely" says."""
_HALF_WIDTH = 2.0
"""From the middle between both marks of the vendor's rule to each of them [dB]."""


class Power:
    """Compares the power of the first path with that of everything received.

    Args:
        middle: difference that says nothing [dB].

    Source: LinkTrack user manual: a difference below 6 dB makes line of sight likely, one above 10 dB makes a
    blocked range or multipath likely. Likely is taken for ten to one; it gets no likelier beyond the marks.
    """

    def __init__(self, middle: float) -> None:
        self._middle = middle

    def log_ratio(self, rx_power: float, fp_power: float) -> float:
        """How much the powers [dBm] of a range speak for a blocked one; nothing when there are none."""
        difference = rx_power - fp_power
        if not isfinite(difference):
            return 0.0
        return LIKELY * min(max((difference - self._middle) / _HALF_WIDTH, -1.0), 1.0)
