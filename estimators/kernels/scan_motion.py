"""What is thought of the motion between two scans: prior on the states, and how far it bends a scan."""

import numpy as np

from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.kernels.scan_lines import IntegerArray
from estimators.messages import FloatArray

LEAST_INFORMATION = 1e-8
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


@compiled(f"{MATRIX}({MATRIX}, {VECTOR}, {MATRIX}, {INDICES}, {MATRIX})")
def bent(
    modes: FloatArray, shares: FloatArray, rows: FloatArray, index: IntegerArray, deviation: FloatArray
) -> FloatArray:
    """Covariance (3, 3) that the pose at the end has because motion between the states bends the scan.

    Each mode moves the beams, and by them the pose that fits best.

    Args:
        modes: (K, N) of the motion at the instants of the beams.
        shares: (N,) of the way in time from the scan before to this one, of the beams.
        rows: (N, 6) of `associate`.
        index: (N,) of `associate`; beams without a line say nothing.
        deviation: (3, 3) covariance of what the modes are multiples of.
    """
    count = len(modes)
    hessian, pulls = LEAST_INFORMATION * np.eye(3), np.zeros((3, count, 3))
    for i in range(len(rows)):
        if index[i] < 0:
            continue
        for a in range(3):
            by_end = shares[i] * rows[i, 1 + a]
            for b in range(3):
                by_both = by_end * rows[i, 1 + b]
                hessian[a, b] += shares[i] * by_both
                for k in range(count):
                    pulls[a, k, b] += modes[k, i] * by_both
    gains = np.linalg.solve(hessian, pulls.reshape(3, 3 * count))
    cov = np.zeros((3, 3))
    for k in range(count):
        gain = gains[:, 3 * k : 3 * k + 3].copy()
        cov += gain @ deviation @ gain.T
    return 0.5 * (cov + cov.T)
