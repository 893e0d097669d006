"""Position of a tag from ranges to three or more anchors in the plane."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from estimators.messages import FloatArray

COLLINEAR_LIMIT = 0.1
"""Least spread [m] of the anchors across their best-fit line; below it left and right look the same."""


class AnchorGeometryError(ValueError):
    """The anchors cannot give a position in the plane."""


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A position from ranges.

    Attributes:
        position: (2,) [m], map frame.
        cov: (2, 2) [m^2].
        residuals: (N,) measured minus predicted range [m].
    """

    position: FloatArray
    cov: FloatArray
    residuals: FloatArray


def check_anchor_geometry(anchors: FloatArray) -> None:
    """Refuse anchor layouts that leave the position in the plane ambiguous.

    Args:
        anchors: (N, 2) or (N, 3) positions [m]; only x and y count.

    Raises:
        AnchorGeometryError: fewer than 3, or all within `COLLINEAR_LIMIT` of one line.

    Source: huang2024 Eq. (4), which needs three anchors that are not in line.
    """
    if len(anchors) < 3:
        raise AnchorGeometryError(f"{len(anchors)} anchors given, a position needs at least 3")
    plan = anchors[:, :2] - anchors[:, :2].mean(axis=0)
    across = float(np.abs(plan @ np.linalg.svd(plan)[2][1]).max())
    if across < COLLINEAR_LIMIT:
        raise AnchorGeometryError(
            f"all {len(anchors)} anchors lie within {across:.2f} m of one line (at least "
            f"{COLLINEAR_LIMIT} m is needed): positions left and right of it look the same"
        )


def trilaterate(anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray) -> Fix:
    """Weighted least-squares position from horizontal ranges.

    The closed form (differences of squared ranges, linear in x and y) starts a Levenberg-Marquardt
    iteration (MINPACK) on the ranges themselves.

    Args:
        anchors: (N, 2) anchor positions [m].
        ranges: (N,) horizontal ranges [m].
        sigmas: (N,) their standard deviations [m].

    Raises:
        AnchorGeometryError: fewer than 3 anchors, or all in line.

    Source: huang2024 Eq. (4), generalised to N anchors.
    """
    check_anchor_geometry(anchors)

    def offsets(position: FloatArray) -> tuple[FloatArray, FloatArray]:
        offset = position - anchors
        distance: FloatArray = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        return offset, distance

    def residuals(position: FloatArray) -> FloatArray:
        return (offsets(position)[1] - ranges) / sigmas

    def jacobian(position: FloatArray) -> FloatArray:
        offset, distance = offsets(position)
        return offset / (distance * sigmas)[:, None]

    found = least_squares(residuals, _closed_form(anchors, ranges), jacobian, method="lm", xtol=1e-10)
    position = np.asarray(found.x, dtype=np.float64)
    information = jacobian(position).T @ jacobian(position)
    cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Fix(position, cov, -residuals(position) * sigmas)


def _closed_form(anchors: FloatArray, ranges: FloatArray) -> FloatArray:
    centre = anchors.mean(axis=0)
    local = anchors - centre
    # |p - a_i|^2 = r_i^2 minus the mean of the same equations leaves 2 (a_i - mean) p on the left.
    square = (local**2).sum(axis=1) - ranges**2
    solution, *_ = np.linalg.lstsq(2.0 * local, square - square.mean(), rcond=None)
    position: FloatArray = centre + solution
    return position
