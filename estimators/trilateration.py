"""Position of a tag in the plane from ranges to anchors, and both where two fit."""

import numpy as np
from scipy.optimize import least_squares

from estimators.immutable import immutable
from estimators.messages import FloatArray

COLLINEAR_LIMIT = 0.1
"""Least spread [m] of the anchors across their best-fit line; below it left and right look the same."""

MIRROR_LOSS = 9.0
"""Sum of squared normalised residuals by which a mirrored position must be worse to be ruled out: 3 sigma."""
SAME_POSITION = 1e-3
"""Iterations that end nearer to each other than this [m] have found one position."""
OPEN_DIRECTION = 1e-3
"""Least share of the information in one direction that the other must have."""


class AnchorGeometryError(ValueError):
    """The anchors cannot give a position in the plane."""


@immutable
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


def trilaterate(anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray) -> tuple[Fix, ...]:
    """Weighted least-squares positions from horizontal ranges.

    The closed form (differences of squared ranges, linear in x and y) starts a Levenberg-Marquardt iteration
    (MINPACK) on the ranges themselves. A second one starts on the other side of the anchors' best-fit line:
    two anchors, or several nearly in line, leave two positions.

    Args:
        anchors: (N, 2) anchor positions [m].
        ranges: (N,) horizontal ranges [m].
        sigmas: (N,) their standard deviations [m].

    Returns:
        The position that fits best; after it the mirrored one, when it fits not clearly worse. None at all
        when the tag stands so near the line of its anchors that they say nothing of the distance from it.

    Raises:
        AnchorGeometryError: fewer than two anchors that stand apart.

    Source: huang2024 Eq. (4), generalised to N anchors in any layout.
    """
    centre = anchors.mean(axis=0) if len(anchors) else np.zeros(2)
    local = anchors - centre
    if len(anchors) == 0 or float(np.abs(local).max()) < COLLINEAR_LIMIT:
        raise AnchorGeometryError(f"{len(anchors)} anchors on one spot, a position needs at least 2 apart")
    across: FloatArray = np.linalg.svd(local)[2][1]
    foot, height = _closed_form(local, ranges, across)
    fixes = [_iterate(anchors, ranges, sigmas, centre + foot + side * across) for side in (height, -height)]
    fits = sorted((fix for fix in fixes if fix is not None), key=lambda fix: _loss(fix, sigmas))
    if len(fits) == 2:
        best, other = fits
        same = float(np.linalg.norm(best.position - other.position)) < SAME_POSITION
        if same or _loss(other, sigmas) - _loss(best, sigmas) > MIRROR_LOSS:
            return (best,)
    return tuple(fits)


def circle_intersections(
    first: FloatArray, second: FloatArray, first_range: float, second_range: float
) -> tuple[FloatArray, ...]:
    """Where the circles round two anchors meet.

    Args:
        first: (2,) anchor [m].
        second: (2,) the other [m].
        first_range: radius round the first [m].
        second_range: radius round the second [m].

    Returns:
        Two positions (2,) [m]; the one nearest to both circles where they do not meet; none when the anchors
        stand on one spot.
    """
    base = second - first
    length = float(np.hypot(base[0], base[1]))
    if length < COLLINEAR_LIMIT:
        return ()
    along = (first_range**2 - second_range**2 + length**2) / (2.0 * length)
    square = first_range**2 - along**2
    unit = base / length
    if square <= 0.0:
        # Apart, or one within the other, or touching, which rounding takes for either.
        nearest = max(
            (length - first_range - second_range, first_range + length - second_range),
            (first_range - second_range - length, first_range + length + second_range),
            (second_range - first_range - length, length - first_range - second_range),
        )
        return (first + 0.5 * nearest[1] * unit,)
    across = np.sqrt(square) * np.array([-unit[1], unit[0]])
    foot = first + along * unit
    return foot + across, foot - across


def _closed_form(local: FloatArray, ranges: FloatArray, across: FloatArray) -> tuple[FloatArray, float]:
    """Position (2,) on the anchors' best-fit line, and signed distance from it; relative to the centre."""
    # |p - a_i|^2 = r_i^2 minus the mean of the same equations leaves 2 (a_i - mean) p on the left.
    square = (local**2).sum(axis=1) - ranges**2
    right = square - square.mean()
    if float(np.abs(local @ across).max()) >= COLLINEAR_LIMIT:
        solution = np.linalg.lstsq(2.0 * local, right, rcond=None)[0]
        height = float(solution @ across)
        return solution - height * across, height
    along = np.array([across[1], -across[0]])
    foot = np.linalg.lstsq(2.0 * (local @ along)[:, None], right, rcond=None)[0][0] * along
    left_over = (ranges**2 - ((foot - local) ** 2).sum(axis=1)).mean()
    return foot, float(np.sqrt(max(left_over, 0.0)))


def _iterate(anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray, start: FloatArray) -> Fix | None:
    """The minimum near a start; None where it leaves a direction open."""

    def offsets(position: FloatArray) -> tuple[FloatArray, FloatArray]:
        offset = position - anchors
        distance: FloatArray = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        return offset, distance

    def residuals(position: FloatArray) -> FloatArray:
        return (offsets(position)[1] - ranges) / sigmas

    def jacobian(position: FloatArray) -> FloatArray:
        offset, distance = offsets(position)
        return offset / (distance * sigmas)[:, None]

    found = least_squares(residuals, start, jacobian, method="lm", xtol=1e-10)
    position = np.asarray(found.x, dtype=np.float64)
    information = jacobian(position).T @ jacobian(position)
    least, greatest = np.linalg.eigvalsh(information)
    if least < OPEN_DIRECTION * greatest:
        return None
    cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Fix(position, cov, -residuals(position) * sigmas)


def _loss(fix: Fix, sigmas: FloatArray) -> float:
    return float(((fix.residuals / sigmas) ** 2).sum())
