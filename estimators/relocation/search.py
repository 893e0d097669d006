"""The pose that ranges along a piece of way speak for, from nothing.

The way is rigid, so three numbers are looked for: x, y and yaw of its frame in the map. The loss of a range
is quadratic for what noise explains. For one that is too long, as ranges are that something blocks, it is
bounded; for one that is too short never. Circles of any two anchors give places to begin at, all headings
around are tried, and Gauss-Newton steps on all of them together end in the minima.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimators import chi2
from estimators.geometry import wrap_angles
from estimators.immutable import immutable
from estimators.messages import FloatArray
from estimators.relocation.window import PlacedRanges
from estimators.trilateration import circle_intersections

BLOCKED_LOSS = 2.8
"""Most that one range which is too long can cost: minus the logarithm of how much likelier a good one is.

A good range of sigma 0.1 m has a density of 0.8 * 4.0 / m, one of a fifth that are blocked, with excesses
up to a metre, about 0.2 / m: their ratio is 16.
"""
SHORT_LIMIT = 3.0
"""Where the loss of a range that is too short goes on as a straight line [sigma]."""
HEADINGS = 8
"""Tried at every place: 45 deg apart, so that one is 22.5 deg off at most."""
SEED_ANCHORS = 5
"""So many of the nearest anchors, whose ranges are blocked least often, give places to begin at."""
COARSE_SHARE = 4
"""The first steps use every so manieth range of each anchor."""
COARSE_STEPS = (4.0, 2.0, 1.0, 1.0)
"""Factors on all sigmas, a Gauss-Newton step each: at first distant minima draw, too."""
FINE_STEPS = (1.0,) * 8
FINALISTS = 12
"""So many of the best poses that are not the same go on with all ranges."""
LONGEST_STEP = np.array([1.0, 1.0, 0.6])
"""[m, m, rad]: a straight line is no good likeness of a circle further on."""
SAME_PLACE = np.array([0.3, 0.3, 0.35])
"""Minima nearer to each other than this are one [m, m, rad]."""


@immutable
class Minimum:
    """A pose that ranges along a way speak for.

    Attributes:
        pose: (3,) of the way's frame, map frame.
        cov: (3, 3), odometry's drift and the anchors' biases included.
        loss: total of all ranges.
        agreeing: share of ranges within `SHORT_LIMIT` sigma.
        least_agreeing: the same in that third of the ranges where it is least; in stamp order.
        mean_square: of these, normalised.
        rival: loss of the best other minimum, infinite when there is none.
    """

    pose: FloatArray
    cov: FloatArray
    loss: float
    agreeing: float
    least_agreeing: float
    mean_square: float
    rival: float


def residuals_at(placed: PlacedRanges, poses: FloatArray) -> FloatArray:
    """Measured minus predicted ranges (S, N) in sigmas if the way's frame stood at the poses (S, 3)."""
    *_, distance = _offsets(placed, poses)
    residuals: FloatArray = (placed.ranges - distance) / placed.sigmas
    return residuals


def total_loss(residuals: FloatArray) -> FloatArray:
    """Loss (S,) of all ranges with residuals (S, N) in sigmas."""
    too_long = BLOCKED_LOSS * -np.expm1(-(residuals**2) / (2.0 * BLOCKED_LOSS))
    size = np.abs(residuals)
    too_short = np.where(size < SHORT_LIMIT, 0.5 * size**2, SHORT_LIMIT * (size - 0.5 * SHORT_LIMIT))
    losses: FloatArray = np.where(residuals > 0.0, too_long, too_short).sum(axis=1)
    return losses


def too_short(residuals: FloatArray) -> float:
    """Share of residuals in sigmas that are too short by more than `SHORT_LIMIT`."""
    return float((residuals < -SHORT_LIMIT).mean())


def agreeing(residuals: FloatArray) -> float:
    """Share of residuals in sigmas within `SHORT_LIMIT`."""
    return float((np.abs(residuals) < SHORT_LIMIT).mean())


def find_pose(placed: PlacedRanges, bias_sigma: float) -> Minimum | None:
    """The pose with the least loss.

    Args:
        placed: ranges along the way.
        bias_sigma: standard deviation of what all ranges of an anchor have in common [m].

    Returns:
        None when the ranges come from fewer than two anchors, or leave the heading without any hold.

    Source: iteratively reweighted least squares with graduated softening: Yang et al., Graduated
    Non-Convexity for Robust Spatial Perception, RA-L 2020; the one-sided loss is ours.
    """
    poses = _seeds(placed)
    if not len(poses):
        return None
    coarse = placed.some(np.argsort(placed.anchor_ids, kind="stable")[::COARSE_SHARE])
    poses = _descend(coarse, poses, COARSE_STEPS)
    poses = _best_apart(poses, total_loss(residuals_at(coarse, poses)))
    poses = _descend(placed, poses, FINE_STEPS)
    losses = total_loss(residuals_at(placed, poses))
    best = int(np.argmin(losses))
    others = losses[_is_elsewhere(poses, poses[best])]
    pose = poses[best]
    pose[2] = float(wrap_angles(pose[2:])[0])
    residuals, jacobian = _linearised(placed, pose[None])
    cov = _covariance(placed, pose, residuals, jacobian, bias_sigma)
    if cov is None:
        return None
    agree = np.abs(residuals[0]) < SHORT_LIMIT
    mean_square = float((residuals[0, agree] ** 2).mean()) if agree.any() else np.inf
    return Minimum(
        pose=pose,
        # Ranges that agree less well than their noise allows hold the pose less well, too.
        cov=cov * max(1.0, mean_square),
        loss=float(losses[best]),
        agreeing=agreeing(residuals),
        least_agreeing=min(float(third.mean()) for third in np.array_split(agree, 3)),
        mean_square=mean_square,
        rival=float(others.min()) if len(others) else np.inf,
    )


def _best_apart(poses: FloatArray, losses: FloatArray) -> FloatArray:
    """The poses of least loss, one of each place."""
    left = poses[np.argsort(losses, kind="stable")]
    kept: list[FloatArray] = []
    while len(left) and len(kept) < FINALISTS:
        kept.append(left[0])
        left = left[_is_elsewhere(left, left[0])]
    return np.array(kept)


def _is_elsewhere(poses: FloatArray, pose: FloatArray) -> NDArray[np.bool_]:
    """Which of the poses (S, 3) are not the same as one (3,)."""
    apart = np.abs(poses - pose)
    apart[:, 2] = np.abs(wrap_angles(apart[:, 2]))
    return np.asarray((apart > SAME_PLACE).any(axis=1))


def _descend(placed: PlacedRanges, poses: FloatArray, steps: tuple[float, ...]) -> FloatArray:
    """Gauss-Newton steps on every pose (S, 3)."""
    for softening in steps:
        residuals, jacobian = _linearised(placed, poses)
        information, gradient = _normal_equations(residuals, jacobian, softening)
        information += 1e-6 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        poses = poses + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    return poses


def _offsets(placed: PlacedRanges, poses: FloatArray) -> tuple[FloatArray, ...]:
    """How tags lie from the body's origin, x and y, how they lie from anchors, and how far, each (S, N)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    arm_x = c * placed.tags[:, 0] - s * placed.tags[:, 1]
    arm_y = s * placed.tags[:, 0] + c * placed.tags[:, 1]
    dx = poses[:, 0:1] + arm_x - placed.anchors[:, 0]
    dy = poses[:, 1:2] + arm_y - placed.anchors[:, 1]
    return arm_x, arm_y, dx, dy, np.maximum(np.hypot(dx, dy), 1e-9)


def _linearised(placed: PlacedRanges, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As `residuals_at`, and what they lose by x, y and yaw, (S, N, 3)."""
    arm_x, arm_y, dx, dy, distance = _offsets(placed, poses)
    scale = distance * placed.sigmas
    ux, uy = dx / scale, dy / scale
    residuals = (placed.ranges - distance) / placed.sigmas
    return residuals, np.stack([ux, uy, uy * arm_x - ux * arm_y], axis=2)


def _normal_equations(
    residuals: FloatArray, jacobian: FloatArray, softening: float
) -> tuple[FloatArray, FloatArray]:
    """Information (S, 3, 3) and gradient (S, 3)."""
    soft = residuals / softening
    weights = np.where(
        soft > 0.0,
        np.exp(-(soft**2) / (2.0 * BLOCKED_LOSS)),
        SHORT_LIMIT / np.maximum(-soft, SHORT_LIMIT),
    )
    weighted = (jacobian * weights[:, :, None]).transpose(0, 2, 1)
    return weighted @ jacobian, (weighted @ residuals[:, :, None])[:, :, 0]


def _seeds(placed: PlacedRanges) -> FloatArray:
    """Poses (S, 3) that put the middle of the way where circles round two anchors meet, facing anywhere."""
    middle = placed.tags[len(placed.tags) // 2]
    near = np.argsort(((placed.tags - middle) ** 2).sum(axis=1), kind="stable")
    _, first = np.unique(placed.anchor_ids[near], return_index=True)
    chosen = near[first]
    chosen = chosen[np.argsort(placed.ranges[chosen], kind="stable")[:SEED_ANCHORS]]
    places = [
        place
        for i, k in combinations(chosen, 2)
        for place in circle_intersections(
            placed.anchors[i], placed.anchors[k], float(placed.ranges[i]), float(placed.ranges[k])
        )
    ]
    if not places:
        return np.empty((0, 3))
    yaws = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
    c, s = np.cos(yaws), np.sin(yaws)
    arms = np.column_stack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    origins = (np.array(places)[:, None] - arms).reshape(-1, 2)
    return np.column_stack([origins, np.tile(yaws, len(places))])


def _covariance(
    placed: PlacedRanges, pose: FloatArray, residuals: FloatArray, jacobian: FloatArray, bias_sigma: float
) -> FloatArray | None:
    """Covariance of a minimum from noise, from the anchors' biases, and from the odometry's steps.

    A step's error moves all of the way behind it at once, a bias all ranges of an anchor: such errors do not
    average out, and the inverse of the information alone would leave them away.

    Source: Huber, Robust Statistics, 1981, 6.3, covariance of an M-estimate under errors of any covariance.
    """
    information, _ = _normal_equations(residuals, jacobian, 1.0)
    J = jacobian[0]
    weights = np.exp(-(np.maximum(residuals[0], 0.0) ** 2) / (2.0 * BLOCKED_LOSS))
    weighted = J * weights[:, None]
    spread = information[0].copy()
    for anchor_id in np.unique(placed.anchor_ids):
        of_anchor = placed.anchor_ids == anchor_id
        pull = (weighted[of_anchor] / placed.sigmas[of_anchor, None]).sum(axis=0)
        spread += bias_sigma**2 * np.outer(pull, pull)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    # Direction of each range's change in the frame of the way.
    along = np.column_stack([c * J[:, 0] + s * J[:, 1], c * J[:, 1] - s * J[:, 0]])
    for k, (begin, end, cov) in enumerate(
        zip(placed.step_poses, placed.step_ends, placed.step_covs, strict=True)
    ):
        older = placed.steps > k
        g, arm = along[older], placed.tags[older] - end
        cb, sb = np.cos(begin[2]), np.sin(begin[2])
        by_step = -np.column_stack(
            [
                cb * g[:, 0] + sb * g[:, 1],
                cb * g[:, 1] - sb * g[:, 0],
                g[:, 1] * arm[:, 0] - g[:, 0] * arm[:, 1],
            ]
        )
        pull_of_step = weighted[older].T @ by_step
        spread += pull_of_step @ cov @ pull_of_step.T
    try:
        inverse = np.linalg.inv(information[0])
    except np.linalg.LinAlgError:
        return None
    cov = inverse @ spread @ inverse
    cov = 0.5 * (cov + cov.T)
    return cov if np.isfinite(cov).all() and np.linalg.eigvalsh(cov)[0] > 0.0 else None


def lies_outside(pose: FloatArray, other: FloatArray, cov: FloatArray, confidence: float) -> bool:
    """Whether two poses differ by more than a covariance (3, 3) of their difference explains."""
    error = pose - other
    error[2] = float(wrap_angles(error[2:])[0])
    return bool(error @ np.linalg.solve(cov, error) > chi2.ppf(confidence, 3))
