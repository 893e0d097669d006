"""Quantiles of the chi-square law against those of SciPy's statistics."""

import pytest
from scipy.stats import chi2 as reference

from estimators import chi2


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 50])
def test_quantiles_are_those_of_scipy(dof: int) -> None:
    for share in (0.0, 0.025, 0.5, 0.95, 0.997, 0.99999):
        assert chi2.ppf(share, dof) == pytest.approx(float(reference.ppf(share, dof)), rel=1e-12)
