"""A log smoothed as a whole: the course that fits all of it best, and anchors where ranges say they are."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference, compare
from companion.log import Log, Truth
from companion.pipeline import Tick
from companion.replay import Replay, Stopwatch, replay
from estimators.base import Setup
from estimators.geometry import lift
from estimators.graph.batch import AnchorFix, Smoothed, smooth
from estimators.graph.errors import GraphError
from estimators.graph.recording import PLACE_SIGMA, Noise, Recording
from estimators.graph.smoother import GraphSmoother
from estimators.immutable import immutable
from estimators.messages import (
    FloatArray,
    IntArray,
    Measurement,
    PoseEstimate,
    RangeFrame,
    measurement_stamp_ns,
)
from estimators.models.range_bias import without_bearing_bias

SMOOTHED = "smoothed"
"""Name of the smoothed track beside the estimators'."""


@immutable
class SmoothedLog:
    """What smoothing a log gave.

    Attributes:
        replay: tracks and their errors: the smoothed one, then the estimator's as it would be live. Its
            configuration has the anchors where they were found.
        smoothed: poses and anchors.
        moved: anchor id -> (2,) from its place in the site file to where it was found [m].
        gauge: what holds the frame in which all this is.
    """

    replay: Replay
    smoothed: Smoothed
    moved: dict[int, FloatArray]
    gauge: str


def smooth_log(
    log: Log,
    config: Config,
    find_anchors: bool,
    find_biases: bool,
    on_progress: Callable[[float], None] | None = None,
) -> SmoothedLog:
    """Smooth a log.

    The sensors' bytes go through the decoders and the front end of a live run. The search begins at the
    track of the site's estimator; where anchors are to be found, at that of the odometry alone.

    Args:
        log: to read.
        config: usually `config_of(log)`.
        find_anchors: x and y of the anchors are to be found.
        find_biases: biases of their ranges are to be found.
        on_progress: called now and then with the share that is done.

    Raises:
        UserError: the log holds nothing to smooth, or does not determine what is asked for.
    """
    measurements: list[Measurement] = []

    def collect(tick: Tick, _: Truth | None) -> None:
        measurements.extend(outcome.measurement for outcome in tick.outcomes)

    def replayed(share: float) -> None:
        if on_progress is not None:
            on_progress(0.7 * share)

    primary = config.pipeline.estimator
    names = list(dict.fromkeys([primary, "lidar_odometry"])) if find_anchors else [primary]
    result = replay(log, config, names, collect, replayed, close_loops=True)
    begin = time.perf_counter()
    settings = config.estimator_config("graph")
    assert isinstance(settings, GraphSmoother.Config)
    noise = Noise(settings.range_sigma, settings.accel_noise, settings.yaw_accel_noise)
    setup = config.setup()
    track = result.poses[names[-1]]
    guess = _interpolated(log, track)
    # The median, because a heading may be found on the way; infinite without any, then no bias is taken off.
    yaw_variance = float(np.median([pose.planar_cov[2, 2] for pose in track]))
    measurements = _without_bearing_biases(measurements, setup, guess, yaw_variance)
    try:
        recording = Recording(measurements, setup, noise)
        smoothed = smooth(
            recording,
            guess,
            find_anchors,
            find_biases,
            lambda number: on_progress(0.7 + 0.05 * number) if on_progress is not None else None,
        )
    except GraphError as error:
        raise UserError(f"{log.path}: cannot be smoothed: {error}") from error
    took = time.perf_counter() - begin
    poses = _pose_estimates(smoothed, setup)
    truths = [record for record in Log(log.path) if isinstance(record, Truth)]
    both = Replay(
        config=config.model_copy(update={"anchors": _anchors(config, smoothed.anchors)}),
        names=[SMOOTHED, primary],
        poses={SMOOTHED: poses, primary: result.poses[primary]},
        update_times={
            SMOOTHED: Stopwatch(len(poses), took),
            primary: result.update_times[primary],
        },
        duration=result.duration,
        complete=result.complete,
    )
    if truths:
        reference = Reference(truths)
        covered = sum(reference.covers(pose.stamp_ns) for pose in poses)
        both.errors = {
            SMOOTHED: compare(poses, reference, covered),
            primary: result.errors[primary],
        }
    moved = {i: fix.position - setup.anchors[i][:2] for i, fix in smoothed.anchors.items()}
    return SmoothedLog(both, smoothed, moved, _gauge(config, find_anchors))


def anchors_toml(found: SmoothedLog) -> str:
    """The anchors where they were found, as a table for a site file."""
    lines = ["[anchors] # id = [x, y, z] in metres; z as it was"]
    for anchor_id, (x, y, z) in found.replay.config.anchors.items():
        fix = found.smoothed.anchors[anchor_id]
        bias = f" # bias {fix.bias:+.3f} m" if fix.bias_sigma else ""
        lines.append(f"{anchor_id} = [{x:.3f}, {y:.3f}, {z:.3f}]{bias}")
    return "\n".join(lines) + "\n"


def _without_bearing_biases(
    measurements: Sequence[Measurement],
    setup: Setup,
    guess: Callable[[IntArray], FloatArray],
    yaw_variance: float,
) -> list[Measurement]:
    """The measurements, and what depends on the bearing taken off their ranges at guessed poses."""
    biases = setup.bearing_biases
    poses = guess(np.array([measurement_stamp_ns(m) for m in measurements], dtype=np.int64))
    return [
        without_bearing_bias(m, biases[m.tag_id], pose, setup.anchors, setup.arm(m.tag_id), yaw_variance)
        if isinstance(m, RangeFrame) and m.tag_id in biases
        else m
        for m, pose in zip(measurements, poses, strict=True)
    ]


def _interpolated(log: Log, poses: Sequence[PoseEstimate]) -> Callable[[IntArray], FloatArray]:
    """Poses (K, 3) of a track at any instants (K,)."""
    if not poses:
        raise UserError(f"{log.path}: cannot be smoothed: its estimator gives no pose to begin at")
    track = Reference([Truth(pose.stamp_ns, np.array([*pose.xy, pose.yaw])) for pose in poses])
    return lambda instants_ns: track.at(instants_ns.tolist())


def _pose_estimates(smoothed: Smoothed, setup: Setup) -> list[PoseEstimate]:
    return [
        PoseEstimate(stamp_ns, lift(pose, setup.height), setup.lift_covariance(cov), 0)
        for stamp_ns, pose, cov in zip(
            smoothed.stamps_ns.tolist(), smoothed.poses, smoothed.covs, strict=True
        )
    ]


def _anchors(config: Config, fixes: dict[int, AnchorFix]) -> dict[int, tuple[float, float, float]]:
    return {
        anchor_id: (*fixes[anchor_id].position.tolist(), place[2])
        for anchor_id, place in config.anchors.items()
    }


def _gauge(config: Config, find_anchors: bool) -> str:
    start = config.start
    mark = f"start mark ({start.sigma_xy:g} m, {start.sigma_yaw_deg:g} deg)"
    if find_anchors:
        return (
            f"{mark} and anchors of the site file ({PLACE_SIGMA:g} m each) hold the frame; a mirror image "
            "is ruled out by where the search begins"
        )
    return f"{mark} and known anchors hold the frame"
