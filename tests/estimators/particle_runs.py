"""Runs of particle filters in the matched world, with or without landmarks."""

from dataclasses import replace

import numpy as np

from estimators import estimator_config_class, make_estimator
from estimators.base import Estimator
from estimators.messages import FloatArray, LandmarkFrame, Measurement
from tests.estimators.matched_world import (
    HALL,
    STEP,
    STEP_NS,
    matched_config,
    measured_walk,
    pose_error,
    random_truth,
)

MARKED_HALL = replace(
    HALL, landmarks={i: np.array(p) for i, p in enumerate([(-5.0, 1.0), (4.0, 5.0), (3.0, -6.0), (6.0, 0.0)])}
)
RANGE_SIGMA, BEARING_SIGMA = 0.03, 0.012


def matched_filter(name: str, **settings: object) -> Estimator:
    """Estimator in `MARKED_HALL` with the matched world's noise and open gates."""
    matched = {**matched_config().model_dump(), "landmark_gate": 1 - 1e-9, **settings}
    return make_estimator(name, estimator_config_class(name).model_validate(matched), MARKED_HALL)


def seen_landmarks(stamp_ns: int, pose: FloatArray, rng: np.random.Generator) -> LandmarkFrame:
    """Every landmark, with noise."""
    away = np.array(list(MARKED_HALL.landmarks.values())) - pose[:2]
    count = len(away)
    ranges = np.hypot(*away.T) + rng.normal(0.0, RANGE_SIGMA, count)
    bearings = np.arctan2(away[:, 1], away[:, 0]) - pose[2] + rng.normal(0.0, BEARING_SIGMA, count)
    ids = np.array(list(MARKED_HALL.landmarks))
    return LandmarkFrame(stamp_ns, ids, ranges, bearings, RANGE_SIGMA, BEARING_SIGMA)


def matched_run(seed: int, seconds: float, landmarks: bool) -> tuple[FloatArray, list[Measurement]]:
    """True states (N, 6) every `STEP`, and all measurements in stamp order."""
    rng = np.random.default_rng(seed)
    truth = random_truth(rng, seconds)
    stream: list[Measurement] = []
    for k, (stamp_ns, taken) in enumerate(measured_walk(truth, rng)):
        stream += taken
        if landmarks and k % 5 == 0:
            stream.append(seen_landmarks(stamp_ns, truth[k, :3], rng))
    return truth, stream


def errors_and_nees(estimator: Estimator, seed: int, seconds: float, landmarks: bool) -> FloatArray:
    """Squared position error [m^2] and NEES at every half second, (K, 2)."""
    truth, stream = matched_run(seed, seconds, landmarks)
    rows = []
    half = round(0.5 / STEP)
    for i, measurement in enumerate(stream):
        estimator.update(measurement)
        stamp_ns = measurement.stamp_ns
        if i + 1 < len(stream) and stream[i + 1].stamp_ns == stamp_ns:
            continue
        k = stamp_ns // STEP_NS
        if k and k % half == 0:
            pose = estimator.pose_at(stamp_ns)
            assert pose is not None
            error = pose_error(np.array([*pose.xy, pose.yaw]), truth[k])
            rows.append((error[:2] @ error[:2], error @ np.linalg.solve(pose.planar_cov, error)))
    return np.array(rows)
