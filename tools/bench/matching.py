"""Scan matching beside small-gicp, on the same clouds: the scans of the demo's walk, already deskewed.

small-gicp knows neither beams nor planar clouds: it gets them deskewed by us, and the motion between the two
scans before as its first guess. Its GICP needs surfaces in space, so a cloud stands there three times, one
above the other; its ICP takes the flat cloud. How far each is off is in the names of the peers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata
from typing import Any

import numpy as np

from companion.log import Log, Truth
from estimators.geometry import between, compose, lift
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, Scan
from tools.bench.chain import demo_config, demo_log, measurements
from tools.bench.rows import Benchmark, Run

LAYERS = (-0.1, 0.0, 0.1)
_SETTLED = 50


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """A keyframe's cloud and a scan's, what is known of the motion between them, and what it was."""

    keyframe: int
    points: FloatArray
    guess: FloatArray
    ours: FloatArray
    truth: FloatArray


def scan_match() -> Benchmark:
    """A hundred and fifty scans of a robot that sets off, one after the other."""
    config, scans = demo_config(), _scans()

    def match() -> None:
        matcher = ScanMatcher(config.scan_matcher, config.lidar_mounting(), config.scan_preparation)
        for scan in scans:
            matcher.update(scan)

    return Benchmark("ms/scan", "lower", len(scans) / 1e3, match, _peers())


def _scans() -> list[Scan]:
    return [m for m in measurements("lidar") if isinstance(m, Scan)][:150]


@cache
def _pairs() -> tuple[list[FloatArray], list[_Pair]]:
    """Clouds of the keyframes, and all scans matched to them."""
    truths = [record for record in Log(demo_log()) if isinstance(record, Truth)]
    stamps = np.array([truth.stamp_ns for truth in truths])
    poses = np.array([truth.pose for truth in truths])
    poses[:, 2] = np.unwrap(poses[:, 2])

    def pose_at(stamp_ns: int) -> FloatArray:
        since = (stamps - stamps[0]).astype(np.float64)
        return np.array([np.interp(stamp_ns - stamps[0], since, column) for column in poses.T])

    config = demo_config()
    matcher = ScanMatcher(config.scan_matcher, config.lidar_mounting(), config.scan_preparation)
    clouds: list[FloatArray] = []
    pairs: list[_Pair] = []
    newest, step = np.zeros(3), np.zeros(3)
    for scan in _scans():
        found = matcher.update(scan)
        assert found is not None
        if found.from_stamp_ns < found.stamp_ns:
            truth = between(pose_at(found.from_stamp_ns), pose_at(found.stamp_ns))
            pairs.append(
                _Pair(len(clouds) - 1, matcher.points, compose(newest, step), found.increment, truth)
            )
            newest, step = found.increment, between(newest, found.increment)
        if found.is_keyframe:
            clouds.append(matcher.points)
            newest = np.zeros(3)
    return clouds, pairs[_SETTLED:]


def _peers() -> dict[str, Run]:
    try:
        module = import_module("small_gicp")
    except ImportError:
        return {}
    version = metadata.version("small-gicp")
    peers: dict[str, Run] = {}
    _, pairs = _pairs()
    ours = _off([pair.ours for pair in pairs])
    for kind in ("ICP", "GICP"):
        run = _run(module, kind)
        name = f"small-gicp {version} {kind} ({_off(run()):.1f} mm off, ours {ours:.1f} mm)"
        peers[name] = run
    return peers


def _off(found: list[FloatArray]) -> float:
    """Root mean square error of the translations [mm]."""
    errors = [pose[:2] - pair.truth[:2] for pose, pair in zip(found, _pairs()[1], strict=True)]
    return 1e3 * float(np.sqrt((np.array(errors) ** 2).sum(axis=1).mean()))


def _run(module: Any, kind: str) -> Callable[[], list[FloatArray]]:
    heights = np.array([0.0]) if kind == "ICP" else np.array(LAYERS)

    def prepared(points: FloatArray) -> Any:
        flat = np.column_stack([np.repeat(points, len(heights), axis=0), np.tile(heights, len(points))])
        return module.preprocess_points(flat, downsampling_resolution=1e-3, num_threads=1)

    def match() -> list[FloatArray]:
        clouds, pairs = _pairs()
        found: list[FloatArray] = []
        index, target, tree = -1, None, None
        for pair in pairs:
            if pair.keyframe != index:
                index = pair.keyframe
                target, tree = prepared(clouds[index])
            source, _ = prepared(pair.points)
            result = module.align(
                target,
                source,
                tree,
                lift(pair.guess, 0.0),
                registration_type=kind,
                max_correspondence_distance=0.4,
                num_threads=1,
            )
            T = np.asarray(result.T_target_source)
            found.append(np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])]))
        return found

    return match


BENCHMARKS: dict[str, Callable[[], Benchmark]] = {"scan_match": scan_match}
"""Name of the row -> what makes its benchmark."""
