"""The posterior of a pose: beetles that climb it, its mode, and particles around the mode.

It is that of a Gaussian cloud and new measurements. Its arrays go together as a tuple: mean (3,) and lower
Cholesky factor (3, 3) of the cloud; tag antenna (3,) in the body frame, ranges (M, 4), landmarks (L, 6).
Poses are sought in the cloud's own coordinates u, ``pose = mean + factor u``: there it is a unit Gaussian.
"""

from math import cos, log, pi, sin, tan
from typing import TypeAlias

import numpy as np

from estimators.kernels.algebra import cholesky, solve_lower, solve_upper, wrapped
from estimators.kernels.cloud import match, pose_law, put
from estimators.kernels.compilation import MATRIX, VECTOR, compiled, inlined
from estimators.kernels.likelihood import landmark_residuals, normalised, range_residual, residuals
from estimators.messages import FloatArray, IntArray

Posterior: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]

_POSTERIOR = f"Tuple(({VECTOR}, {MATRIX}, {VECTOR}, {MATRIX}, {MATRIX}))"
_PULL = 2.0
"""c1 and c2 of Eq. (21), as in `estimators.beetle_antennae`, like the four below."""
_FIRST_INERTIA, _LAST_INERTIA = 1.0, 0.3
_DISTURBANCE = 0.03
_ANTENNAE = 0.75
MAX_HEADING_SIGMA = 0.35
"""With a less certain heading [rad] a cloud is a ring, not a Gaussian."""
WIDER = 1.1
"""Standard deviations of the Gaussian drawn from, over those of the posterior: weights stay bounded so."""
_NUDGE = 1e-3
"""Step of the numerical derivative, in units of u."""


@inlined
def _pose(u: FloatArray, mean: FloatArray, factor: FloatArray) -> tuple[float, float, float]:
    return (
        mean[0] + factor[0, 0] * u[0],
        mean[1] + factor[1, 0] * u[0] + factor[1, 1] * u[1],
        mean[2] + factor[2, 0] * u[0] + factor[2, 1] * u[1] + factor[2, 2] * u[2],
    )


@compiled(f"float64({VECTOR}, {_POSTERIOR})")
def cost(u: FloatArray, posterior: Posterior) -> float:
    """Negative logarithm of the posterior at u (3,), but for a constant.

    Source: huang2024 Eq. (26), its logarithm, with the cloud's density.
    """
    mean, factor, arm, ranges, landmarks = posterior
    x, y, yaw = _pose(u, mean, factor)
    c, s = cos(yaw), sin(yaw)
    square = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    for j in range(len(ranges)):
        square += (range_residual(x, y, c, s, arm, ranges[j]) / ranges[j, 3]) ** 2
    for j in range(len(landmarks)):
        by_range, by_bearing = landmark_residuals(x, y, yaw, landmarks[j])
        square += (by_range / landmarks[j, 4]) ** 2 + (by_bearing / landmarks[j, 5]) ** 2
    return float(0.5 * square)


@compiled(f"{VECTOR}({MATRIX}, {MATRIX}, {_POSTERIOR})")
def search(particles: FloatArray, uniform: FloatArray, posterior: Posterior) -> FloatArray:
    """Best place that a swarm of beetles finds.

    This is `beetle_antennae.ImprovedBeetleAntennaeSearch`, place for place, in three dimensions.

    Args:
        particles: (N, 9) where the beetles start.
        uniform: (K, 6 N + 3) random numbers of [0, 1), as the search would draw them in K iterations.
        posterior: to be climbed.

    Returns:
        (3,) u of least cost.

    Source: huang2024 Eq. (15)-(25), corrected.
    """
    mean, factor = posterior[:2]
    count = len(particles)
    beetles, own, velocity = np.empty((count, 3)), np.empty((count, 3)), np.zeros((count, 3))
    costs = np.empty(count)
    right, left, centre = np.empty(3), np.empty(3), np.empty(3)
    for i in range(count):
        for j in range(3):
            right[j] = particles[i, j] - mean[j]
        right[2] = wrapped(right[2])
        start = solve_lower(factor, right)
        costs[i] = cost(start, posterior)
        for j in range(3):
            beetles[i, j] = own[i, j] = start[j]
    smelled, smelled_costs = own.copy(), costs.copy()
    for k in range(len(uniform)):
        inertia = _FIRST_INERTIA - (_FIRST_INERTIA - _LAST_INERTIA) * k / len(uniform)  # (18)
        leaders = min(3, (len(smelled) + 1) // 2)
        order = np.argsort(smelled_costs)
        centre[:] = 0.0
        total = 0.0
        for i in range(leaders):
            pull = log(leaders + 0.5) - log(i + 1.0)
            total += pull
            for j in range(3):
                centre[j] += pull * smelled[order[i], j]
        smelled, smelled_costs = np.empty((2 * count, 3)), np.empty(2 * count)
        for i in range(count):
            for j in range(3):
                place = beetles[i, j]
                velocity[i, j] = (  # (21)
                    inertia * velocity[i, j]
                    + _PULL * uniform[k, 3 * i + j] * (own[i, j] - place)
                    + _PULL * uniform[k, 3 * (count + i) + j] * (centre[j] / total - place)
                )
                smelled[i, j] = right[j] = place + (1.0 + _ANTENNAE / 2.0) * velocity[i, j]  # (22)
                smelled[count + i, j] = left[j] = place + (1.0 - _ANTENNAE / 2.0) * velocity[i, j]  # (23)
            right_cost, left_cost = cost(right, posterior), cost(left, posterior)
            smelled_costs[i], smelled_costs[count + i] = right_cost, left_cost
            moved = right if right_cost < left_cost else left  # (24)
            for j in range(3):
                velocity[i, j] = moved[j] - beetles[i, j]
                beetles[i, j] = moved[j]
            if min(right_cost, left_cost) < costs[i]:
                costs[i] = min(right_cost, left_cost)
                for j in range(3):
                    own[i, j] = moved[j]
        best = costs.argmin()
        for j in range(3):  # (25)
            middle, spread = 0.0, 0.0
            for i in range(count):
                middle += beetles[i, j] / count
            for i in range(count):
                spread += abs(beetles[i, j] - middle) / count
            right[j] = own[best, j] + _DISTURBANCE * spread * tan(pi * (uniform[k, 6 * count + j] - 0.5))
        disturbed_cost = cost(right, posterior)
        if disturbed_cost < costs[best]:
            costs[best] = disturbed_cost
            for j in range(3):
                own[best, j] = right[j]
    best = costs.argmin()
    for j in range(3):
        right[j] = own[best, j]
    return right


@compiled(f"Tuple(({VECTOR}, {MATRIX}))({VECTOR}, {_POSTERIOR})")
def gauss_newton(u: FloatArray, posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """One step from u (3,) towards the mode, not taken if it leads upwards.

    Returns:
        u (3,) after the step; lower Cholesky factor (3, 3) of the posterior's information matrix at u.
    """
    mean, factor, arm, ranges, landmarks = posterior
    poses = np.empty((7, 3))
    for k in range(7):
        point = u.copy()
        if k > 0:
            point[(k - 1) // 2] += _NUDGE if k % 2 else -_NUDGE
        poses[k] = _pose(point, mean, factor)
    nudged = residuals(poses, arm, ranges, landmarks)
    information, downhill = np.eye(3), -u
    for j in range(nudged.shape[1]):
        sigma = (
            ranges[j, 3] if j < len(ranges) else landmarks[(j - len(ranges)) // 2, 4 + (j - len(ranges)) % 2]
        )
        row = np.empty(3)
        for a in range(3):
            row[a] = wrapped(nudged[2 * a + 2, j] - nudged[2 * a + 1, j]) / (2.0 * _NUDGE * sigma)
        for a in range(3):
            downhill[a] += row[a] * nudged[0, j] / sigma
            for b in range(3):
                information[a, b] += row[a] * row[b]
    root = cholesky(information)
    stepped = u + solve_upper(root, solve_lower(root, downhill))
    return (stepped if cost(stepped, posterior) < cost(u, posterior) else u), root


@compiled(f"Tuple(({MATRIX}, {VECTOR}, float64))({VECTOR}, {MATRIX}, {MATRIX}, {_POSTERIOR})")
def draw(
    mode: FloatArray, root: FloatArray, normal: FloatArray, posterior: Posterior
) -> tuple[FloatArray, FloatArray, float]:
    """Poses drawn from a Gaussian around the mode, weighted to be samples of the posterior.

    Args:
        mode: (3,) u.
        root: (3, 3) lower Cholesky factor of the information matrix there.
        normal: (N, 3) standard normal numbers.
        posterior: the target.

    Returns:
        Poses (N, 3), map frame; weights (N,) that sum to one; effective sample size.
    """
    mean, factor = posterior[:2]
    poses, logarithms = np.empty((len(normal), 3)), np.empty(len(normal))
    for i in range(len(normal)):
        u = mode + WIDER * solve_upper(root, normal[i])
        square = normal[i, 0] ** 2 + normal[i, 1] ** 2 + normal[i, 2] ** 2
        logarithms[i] = 0.5 * square - cost(u, posterior)
        poses[i] = _pose(u, mean, factor)
    weights = np.empty(len(normal))
    effective = normalised(logarithms, weights)
    return poses, weights, effective


@compiled(
    f"Tuple(({MATRIX}, {VECTOR}, float64))"
    f"({MATRIX}, {VECTOR}, int64[::1], {VECTOR}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX})"
)
def sample(
    particles: FloatArray,
    weights: FloatArray,
    kept: IntArray,
    arm: FloatArray,
    ranges: FloatArray,
    landmarks: FloatArray,
    uniform: FloatArray,
    normal: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Particles of the posterior of a cloud and measurements: search, Gauss-Newton step, and draw.

    Args:
        particles: (N, 9) of the cloud.
        weights: (N,) that sum to one, before the measurements.
        kept: (N,) indices of the particles that new ones take velocity and keyframe from.
        arm: (3,) tag antenna in the body frame [m].
        ranges: (M, 4).
        landmarks: (L, 6).
        uniform: (K, 6 N + 3) random numbers of [0, 1) for K moves of the beetles.
        normal: (N, 3) standard normal numbers; are given the moments that they should have.

    Returns:
        Particles (N, 9); weights (N,) that sum to one; effective sample size, which is 0 when the cloud's
        heading is too uncertain for it to count as Gaussian.
    """
    mean, factor, gain = pose_law(particles, weights)
    chosen = particles[kept]
    if factor[2, 0] ** 2 + factor[2, 1] ** 2 + factor[2, 2] ** 2 > MAX_HEADING_SIGMA**2:
        return chosen, weights, 0.0
    posterior = (mean, factor, arm, ranges, landmarks)
    mode, root = gauss_newton(search(particles, uniform, posterior), posterior)
    match(normal, chosen, np.full(len(kept), 1.0 / len(kept)))
    poses, new_weights, effective = draw(mode, root, normal, posterior)
    put(chosen, poses, gain)
    return chosen, new_weights, effective
