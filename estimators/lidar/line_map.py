"""A scan as local lines, to match points against; numba is loaded with this module."""

import numpy as np
from numpy.typing import NDArray

from estimators.immutable import immutable
from estimators.kernels import scan_fit as kernels
from estimators.kernels.scan_lines import associate, fit_lines, sort_into_cells
from estimators.kernels.scan_motion import newest_covariance, said_by_scan
from estimators.kernels.scan_points import extent
from estimators.lidar.scan_fit import LEAST_INFORMATION, Fit
from estimators.messages import FloatArray, IntArray

LINE_REACH = 10.0
"""Half the length of the neighbourhood through which a line is fitted, in standard deviations of a range."""
CELLS = 4
"""Cells of the grid for each line: a cell along a wall then holds a few lines."""


@immutable
class Surface:
    """Points of a scan that lie on a line with their neighbours.

    Attributes:
        lines: (M, 6) as `fit_lines` gives them.
        spans: (M, 2) first and last point of each line.
        own: (M,) which point each line belongs to.
        points: (M, 2) these points [m].
        normals: (M, 2) unit normals of the lines.
    """

    lines: FloatArray
    spans: IntArray
    own: IntArray
    points: FloatArray
    normals: FloatArray

    def extent(self, scanner: FloatArray) -> tuple[float, float, float]:
        """Mean and greatest distance [m] of the points, at least one; and how squarely beams meet the lines.

        Args:
            scanner: x [m], y [m] of the scanner in the body.

        Returns:
            The third is the root of the mean square of the cosine between a beam and the normal.
        """
        return extent(self.points, self.normals, scanner)


def surface(points: FloatArray, range_sigma: float, wanted: NDArray[np.bool_] | None = None) -> Surface:
    """Lines through points.

    Args:
        points: (N, 2) [m] in the order of the beams.
        range_sigma: standard deviation of a range [m].
        wanted: (N,) whose lines are asked for; None: all.
    """
    if wanted is None:
        wanted = np.ones(len(points), dtype=np.bool_)
    lines, spans, own = fit_lines(points, wanted, LINE_REACH * range_sigma, range_sigma)
    return Surface(lines, spans, own, points.take(own, axis=0), np.ascontiguousarray(lines[:, 2:4]))


@immutable
class Sums:
    """What all matched points say of the state, for distances of unit variance.

    Attributes:
        hessian: (12, 12) and gradient (12,), by the state as `LineMap.match` takes it.
        pose_hessian: (3, 3) by the pose alone.
        feigned: (3, 3) what noise of the normals adds to `pose_hessian` on average.
        weight: sum of the weights.
        squares: weighted sum of squared distances [m^2].
    """

    hessian: FloatArray
    gradient: FloatArray
    pose_hessian: FloatArray
    feigned: FloatArray
    weight: float
    squares: float

    def held(self) -> FloatArray:
        """Projection (3, 3) of a change of the pose [m, rad] on what walls hold."""
        return kernels.held_directions(self.pose_hessian, self.feigned)


class LineMap:
    """Lines of one scan in a grid of cells.

    Args:
        points: (N, 2) [m] in the order of the beams, in the frame of the map.
        range_sigma: standard deviation of a range [m].
        reach: points further than this from a line's foot are not matched [m].
    """

    def __init__(self, points: FloatArray, range_sigma: float, reach: float) -> None:
        found = surface(points, range_sigma)
        feet = found.lines[:, :2]
        lower, upper = (feet.min(axis=0), feet.max(axis=0)) if len(feet) else np.zeros((2, 2))
        width, height = upper - lower
        side = max(reach / CELLS, np.sqrt(width * height / (CELLS * max(len(feet), 1))))
        self._grid = np.array([*lower, side, reach])
        self._columns, rows = int(width * (1.0 / side)) + 1, int(height * (1.0 / side)) + 1
        self._lines, order, self._begin = sort_into_cells(found.lines, self._grid, self._columns, rows)
        self._spans = found.spans[order]
        self._points = len(points)

    def match(
        self, points: FloatArray, normals: FloatArray, basis: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Hold points against their nearest lines.

        Args:
            points: (N, 2) [m], each in the body frame of its own instant.
            normals: (N, 2) unit normals of the surface there, likewise.
            basis: (N, 4) weights of the state's four vectors in the pose at that instant.
            state: (12,) pose and velocity, then pose and velocity, in the frame of the map.

        Returns:
            (N, 6) signed distance [m], its derivative by the pose at the instant (3,), the lever arm of the
            point in the axes of the map (2,); and which line, (N,), -1 without one.
        """
        rows, index = np.empty((len(points), 6)), np.full(len(points), -1)
        associate(
            points, normals, basis, state, self._lines, self._begin, self._grid, self._columns, rows, index
        )
        return rows, index

    def sums(self, basis: FloatArray, rows: FloatArray, index: IntArray, scale: float) -> Sums:
        """Add up what `match` found.

        Args:
            basis: (N, 4) as given to `match`.
            rows: (N, 6) of `match`.
            index: (N,) of `match`.
            scale: of the Cauchy weight [m].
        """
        return Sums(*kernels.normal_equations(basis, rows, index, self._lines, scale))

    def gradient_noise(self, rows: FloatArray, index: IntArray, scale: float) -> FloatArray:
        """Covariance (3, 3) of the gradient by the pose from noise of this map's points, of unit variance.

        Args:
            rows: (N, 6) of `match`.
            index: (N,) of `match`.
            scale: of the Cauchy weight [m].
        """
        return kernels.gradient_noise(rows, index, scale, self._spans, self._points)

    def settle(
        self,
        found: Surface,
        basis: FloatArray,
        prior: FloatArray,
        predicted: FloatArray,
        start: FloatArray,
        sigma: float,
        spread: float,
    ) -> Fit | None:
        """Minimise the distances of surface points from their lines and the deviation from the prediction.

        Args:
            found: surface points of the scan.
            basis: (N, 4) as for `match`.
            prior: (12, 12) information on the states beforehand.
            predicted: (12,) states beforehand.
            start: (12,) states to begin with.
            sigma: least standard deviation of a distance [m].
            spread: how far points may be off at the start [m].

        Returns:
            The fit; None when hardly a point is near a line.
        """
        matched, states, information, held, keyframe_cov, rows, index = kernels.settle(
            found.points,
            found.normals,
            basis,
            self._lines,
            self._spans,
            self._begin,
            self._grid,
            self._columns,
            self._points,
            prior,
            predicted,
            start,
            sigma,
            spread,
        )
        if matched < kernels.LEAST_MATCHED:
            return None
        increment, cov = said_by_scan(
            prior, information, held, keyframe_cov, predicted, states, LEAST_INFORMATION
        )
        return Fit(
            states,
            newest_covariance(information),
            held,
            increment,
            cov,
            matched / len(index),
            rows,
            index,
        )
