"""Quantiles of the chi-square law; `scipy.stats` has them too, but takes a second to load."""

from scipy.special import gammaincinv


def ppf(share: float, dof: float) -> float:
    """Value below which a share of a chi-square law lies.

    Args:
        share: between 0 and 1.
        dof: degrees of freedom.

    Source: Abramowitz and Stegun 26.4.19, its relation to the incomplete gamma function.
    """
    return 2.0 * float(gammaincinv(0.5 * dof, share))
