"""The same graphs in GTSAM, as its users write them: factors and values one by one."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from estimators.messages import FloatArray, IntArray
from tests.estimators.graph.drives import ANCHORS, RANGE_SIGMA, SIGHTING_SIGMA, STEP_SIGMA, Drive


def gtsam_graph(
    drive: Drive, robust: gtsam.noiseModel.mEstimator.Base | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Increments and ranges; anchors are known to a micrometre."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tight = gtsam.noiseModel.Isotropic.Sigma(2, 1e-6)
    for i, anchor in enumerate(ANCHORS):
        values.insert(L(i), anchor)
        graph.add(gtsam.PriorFactorPoint2(L(i), anchor, tight))
    of_step = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMA)
    of_range: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(1, RANGE_SIGMA)
    if robust is not None:
        of_range = gtsam.noiseModel.Robust.Create(robust, of_range)
    for k, guess in enumerate(drive.guess):
        values.insert(X(k), gtsam.Pose2(*guess))
        if k:
            graph.add(gtsam.BetweenFactorPose2(X(k - 1), X(k), gtsam.Pose2(*drive.steps[k - 1]), of_step))
        for i in range(len(ANCHORS)):
            graph.add(gtsam.RangeFactor2D(X(k), L(i), drive.ranges[k, i], of_range))
    return graph, values


def add_closures(graph: gtsam.NonlinearFactorGraph, first: IntArray, second: IntArray, z: FloatArray) -> None:
    """Loop closures with the noise of a step."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMA)
    for a, b, measured in zip(first, second, z, strict=True):
        graph.add(gtsam.BetweenFactorPose2(X(int(a)), X(int(b)), gtsam.Pose2(*measured), noise))


def add_landmarks(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    guess: FloatArray,
    who: IntArray,
    which: IntArray,
    measured: FloatArray,
) -> None:
    """Landmarks, numbered behind the anchors, and what was seen of them."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGHTING_SIGMA[::-1])
    for i, place in enumerate(guess):
        values.insert(L(len(ANCHORS) + i), place)
    for k, i, (distance, bearing) in zip(who, which, measured, strict=True):
        key = L(len(ANCHORS) + int(i))
        graph.add(gtsam.BearingRangeFactor2D(X(int(k)), key, gtsam.Rot2(bearing), distance, noise))


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt until nothing is gained any more."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def poses_of(values: gtsam.Values, count: int) -> FloatArray:
    """Poses (N, 3)."""
    poses = [values.atPose2(X(k)) for k in range(count)]
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
