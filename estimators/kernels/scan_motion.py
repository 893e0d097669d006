"""Motion between two scans: prior, what of the result the scan alone says, and how it bends a scan."""

import numpy as np

from estimators.kernels.algebra import cholesky, wrapped
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.kernels.scan_lines import IntegerArray
from estimators.messages import FloatArray

LEAST_HESSIAN = 1e-8
"""Of the beams on the pose [m^2, rad^2], so that it has an inverse."""


@compiled(f"Tuple(({MATRIX}, {VECTOR}, {VECTOR}))({MATRIX}, {MATRIX}, {VECTOR}, {MATRIX})")
def prior_on_states(
    F: FloatArray, Q: FloatArray, state: FloatArray, cov: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What a state and its transition say of both states together.

    Args:
        F: (6, 6) transition.
        Q: (6, 6) its noise.
        state: (6,) older pose and velocity.
        cov: (6, 6) of it.

    Returns:
        Information (12, 12) on the older and the newer state; both states (12,) as they are predicted;
        standard deviations (3,) of the newer pose.
    """
    of_motion = np.linalg.inv(Q)
    across = F.T @ of_motion
    prior, predicted = np.empty((12, 12)), np.empty(12)
    prior[:6, :6] = across @ F + np.linalg.inv(cov)
    prior[:6, 6:] = -across
    prior[6:, :6] = -across.T
    prior[6:, 6:] = of_motion
    predicted[:6], predicted[6:] = state, F @ state
    return prior, predicted, np.sqrt(np.diag(F @ cov @ F.T + Q)[:3])


@compiled(f"{MATRIX}({MATRIX})")
def newest_information(information: FloatArray) -> FloatArray:
    """Information (3, 3) on the newer pose in that on both states (12, 12), whatever the others are."""
    ordered = np.empty((12, 12))
    order = np.array([0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8])
    for i in range(12):
        for j in range(12):
            ordered[i, j] = information[order[i], order[j]]
    last = cholesky(ordered)[9:, 9:].copy()
    return last @ last.T


@compiled(f"{MATRIX}({MATRIX})")
def newest_covariance(information: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the newer pose and velocity from information on both states (12, 12)."""
    last = cholesky(information)[6:, 6:].copy()
    cov = np.linalg.inv(last @ last.T)
    return 0.5 * (cov + cov.T)


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, {VECTOR}, float64)")
def said_by_scan(
    prior: FloatArray,
    information: FloatArray,
    held: FloatArray,
    keyframe_cov: FloatArray,
    predicted: FloatArray,
    states: FloatArray,
    least: float,
) -> tuple[FloatArray, FloatArray]:
    """Newer pose (3,) and its covariance (3, 3) without what the motion model added.

    Args:
        prior: (12, 12) information on the states beforehand.
        information: (12, 12) the same with the scan.
        held: (3, 3) projection of a change of the pose on what walls hold.
        keyframe_cov: (3, 3) share of the map's own noise.
        predicted: (12,) states beforehand.
        states: (12,) what they became.
        least: information [1/m^2, 1/rad^2] that every direction has.

    Source: Bar-Shalom et al., Tracking and Data Fusion, 9.5: tracklets by decorrelation.
    """
    after = newest_information(information)
    # What walls hold tells of the rest by what the motion model thinks of both: that is not the scan's.
    gained = held @ (after - newest_information(prior)) @ held
    cov = np.linalg.inv(gained + least * np.eye(3))
    pose = predicted[6:9] + held.T @ (cov @ (after @ (states[6:9] - predicted[6:9])))
    pose[2] = wrapped(pose[2])
    cov += keyframe_cov
    return pose, 0.5 * (cov + cov.T)


@compiled(f"{MATRIX}({MATRIX}, {VECTOR}, {MATRIX}, {INDICES}, {MATRIX})")
def bent(
    modes: FloatArray, shares: FloatArray, rows: FloatArray, index: IntegerArray, deviation: FloatArray
) -> FloatArray:
    """Covariance (3, 3) that the pose at the end has because motion between the states bends the scan.

    Each mode moves the beams, and by them the pose that fits best.

    Args:
        modes: (T, K) of the motion at instants that are spread evenly over the time from the scan before to
            this one; between them they are straight.
        shares: (N,) of that time, of the beams; outside of it modes are as at its ends.
        rows: (N, 6) of `associate`.
        index: (N,) of `associate`; beams without a line say nothing.
        deviation: (3, 3) covariance of what the modes are multiples of.
    """
    last, count = len(modes) - 1, modes.shape[1]
    hessian, pulls, mode = LEAST_HESSIAN * np.eye(3), np.zeros((3, count, 3)), np.empty(count)
    for i in range(len(rows)):
        if index[i] < 0:
            continue
        place = last * min(max(shares[i], 0.0), 1.0)
        before = min(int(place), last - 1)
        for k in range(count):
            mode[k] = modes[before, k] + (place - before) * (modes[before + 1, k] - modes[before, k])
        for a in range(3):
            by_end = shares[i] * rows[i, 1 + a]
            for b in range(3):
                by_both = by_end * rows[i, 1 + b]
                hessian[a, b] += shares[i] * by_both
                for k in range(count):
                    pulls[a, k, b] += mode[k] * by_both
    gains = np.linalg.solve(hessian, pulls.reshape(3, 3 * count))
    cov = np.zeros((3, 3))
    for k in range(count):
        gain = gains[:, 3 * k : 3 * k + 3].copy()
        cov += gain @ deviation @ gain.T
    return 0.5 * (cov + cov.T)
