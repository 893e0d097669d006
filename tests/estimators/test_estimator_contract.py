"""What every estimator promises, over the whole table: bad data gets a verdict and harms nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators import ESTIMATORS, estimator_config_class, make_estimator
from estimators.base import Estimator, Report, Verdict, taken_by
from estimators.messages import (
    Attitude,
    FloatArray,
    Height,
    ImuSample,
    LandmarkFrame,
    LoopClosure,
    Measurement,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
    Scan,
    measurement_stamp_ns,
)
from estimators.relocation.recovery import Recovering
from tests.strategies import AGE_NS, HOUR_NS, SETUP, hostile_streams, range_frame

EVERY_ESTIMATOR = pytest.mark.parametrize("name", sorted(ESTIMATORS))
LONG = settings(deadline=None, max_examples=50)

SECOND_NS = 10**9
LONGEST_NOTE = 35
"""Characters that a text to the pilot has room for."""
SMALL_COV = np.diag([1e-4, 1e-4, 1e-5])


def make(name: str) -> Estimator:
    """Estimator with its defaults."""
    return make_estimator(name, estimator_config_class(name)(), SETUP)


def good_ranges(stamp_ns: int) -> RangeFrame:
    """Exact ranges of a robot that stands at the start."""
    x, y, yaw = SETUP.start.pose
    c, s = np.cos(yaw), np.sin(yaw)
    arm = SETUP.tag_in_body
    tag = np.array([x + c * arm[0] - s * arm[1], y + s * arm[0] + c * arm[1], SETUP.height + arm[2]])
    slants = [float(np.linalg.norm(anchor - tag)) for anchor in SETUP.anchors.values()]
    return range_frame(stamp_ns, list(SETUP.anchors), slants)


def standing_robot() -> list[Measurement]:
    """Two seconds of a robot that stands at the start: ranges, increments, a keyframe every second."""
    stream: list[Measurement] = []
    for k in range(21):
        stamp_ns = k * SECOND_NS // 10
        from_stamp_ns = (k - 1) // 10 * SECOND_NS if k else 0
        stream += [
            good_ranges(stamp_ns),
            PoseIncrement(from_stamp_ns, stamp_ns, np.zeros(3), SMALL_COV, k % 10 == 0),
        ]
    return stream


def started(name: str) -> Estimator:
    """Estimator that has seen the standing robot."""
    estimator = make(name)
    for measurement in standing_robot():
        estimator.update(measurement)
    return estimator


def written(pose: PoseEstimate | None) -> tuple[int, bytes, bytes, int] | None:
    """All of a pose, to the last bit."""
    if pose is None:
        return None
    return pose.stamp_ns, pose.T_map_body.tobytes(), pose.cov.tobytes(), pose.reset_counter


def run(estimator: Estimator, stream: list[Measurement]) -> list[object]:
    """Everything an estimator says of a stream, to the last bit."""
    said: list[object] = []
    for measurement in stream:
        report = estimator.update(measurement)
        pose = estimator.pose_at(measurement_stamp_ns(measurement))
        said.append((report.verdicts, report.residuals.tobytes(), report.nis.tobytes(), written(pose)))
    return said


def assert_report_fits(report: Report, measurement: Measurement) -> None:
    """One verdict a range, else one; residuals and NIS one a verdict or none at all."""
    expected = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
    assert len(report.verdicts) == expected
    assert len(report.residuals) in {0, expected}
    assert len(report.nis) in {0, expected}
    assert len(report.note) <= LONGEST_NOTE


def assert_pose_is_sound(pose: PoseEstimate, stamp_ns: int) -> None:
    """Right stamp, a rigid transform, a symmetric covariance without NaN, semidefinite where finite."""
    assert pose.stamp_ns == stamp_ns
    R = pose.T_map_body[:3, :3]
    assert np.isfinite(pose.T_map_body).all()
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(pose.T_map_body[3], [0.0, 0.0, 0.0, 1.0])
    assert not np.isnan(pose.cov).any()
    known = np.isfinite(np.diag(pose.cov))
    # What is not known is so on the diagonal alone, and positively.
    assert (np.diag(pose.cov)[~known] > 0.0).all()
    assert_is_covariance(pose.cov[np.ix_(known, known)])
    assert (pose.velocity is None) == (pose.velocity_cov is None)
    if pose.velocity is not None and pose.velocity_cov is not None:
        assert np.isfinite(pose.velocity).all()
        assert_is_covariance(pose.velocity_cov)


def assert_is_covariance(cov: FloatArray) -> None:
    """Symmetric and semidefinite."""
    values = np.linalg.eigvalsh(cov)
    np.testing.assert_allclose(cov, cov.T, atol=1e-12 * values[-1])
    assert values[0] >= -1e-9 * values[-1]


@EVERY_ESTIMATOR
@LONG
@given(
    stream=hostile_streams(),
    ahead=st.sampled_from([0, 1, 33_000_000, SECOND_NS, -33_000_000, HOUR_NS, -AGE_NS, AGE_NS]),
)
def test_hostile_streams_get_verdicts_and_sound_poses(
    name: str, stream: list[Measurement], ahead: int
) -> None:
    estimator = make(name)
    for measurement in stream:
        assert_report_fits(estimator.update(measurement), measurement)
        stamp_ns = measurement_stamp_ns(measurement) + ahead
        pose = estimator.pose_at(stamp_ns)
        if pose is not None:
            assert_pose_is_sound(pose, stamp_ns)


@EVERY_ESTIMATOR
@LONG
@given(stream=hostile_streams())
def test_hostile_streams_after_an_honest_one(name: str, stream: list[Measurement]) -> None:
    estimator = started(name)
    for measurement in stream:
        assert_report_fits(estimator.update(measurement), measurement)
        pose = estimator.pose_at(2 * SECOND_NS)
        if pose is not None:
            assert_pose_is_sound(pose, 2 * SECOND_NS)


@EVERY_ESTIMATOR
@LONG
@given(stream=hostile_streams())
def test_same_input_twice_and_after_reset_says_the_same(name: str, stream: list[Measurement]) -> None:
    estimator = make(name)
    first = run(estimator, stream)
    assert run(make(name), stream) == first
    estimator.reset()
    assert estimator.pose_at(measurement_stamp_ns(stream[0])) is None
    assert run(estimator, stream) == first


@EVERY_ESTIMATOR
@LONG
@given(stream=hostile_streams(), stamps=st.lists(st.integers(-SECOND_NS, 3 * SECOND_NS), max_size=3))
def test_asking_for_poses_changes_nothing(name: str, stream: list[Measurement], stamps: list[int]) -> None:
    asked, silent = make(name), make(name)
    for measurement in [*standing_robot()[-6:], *stream]:
        for stamp_ns in stamps:
            assert written(asked.pose_at(stamp_ns)) == written(asked.pose_at(stamp_ns))
        asked.update(measurement)
        silent.update(measurement)
    stamp_ns = measurement_stamp_ns(stream[-1])
    assert written(asked.pose_at(stamp_ns)) == written(silent.pose_at(stamp_ns))


@EVERY_ESTIMATOR
def test_no_pose_before_the_first_measurement(name: str) -> None:
    assert make(name).pose_at(0) is None


@EVERY_ESTIMATOR
@pytest.mark.parametrize("away_ns", [AGE_NS, -AGE_NS])
def test_nothing_is_said_of_a_pose_years_away(name: str, away_ns: int) -> None:
    assert started(name).pose_at(2 * SECOND_NS + away_ns) is None


@EVERY_ESTIMATOR
def test_honest_stream_gives_the_true_pose(name: str) -> None:
    pose = started(name).pose_at(2 * SECOND_NS)
    assert pose is not None
    assert_pose_is_sound(pose, 2 * SECOND_NS)
    # An estimator without heading is off by the lever arm at most, one of few particles by millimetres more.
    distance = float(np.linalg.norm(pose.xy - SETUP.start.pose[:2]))
    assert distance <= float(np.linalg.norm(SETUP.tag_in_body[:2])) + 0.01


@pytest.mark.parametrize(
    "name", [name for name in ESTIMATORS if "increment_gate" in estimator_config_class(name).model_fields]
)
def test_the_velocity_is_that_of_the_pose(name: str) -> None:
    estimator = started(name)
    moved = np.array([0.04, 0.02, 0.01])
    for k in range(1, 6):
        stamp_ns = 2 * SECOND_NS + k * SECOND_NS // 10
        estimator.update(PoseIncrement(2 * SECOND_NS, stamp_ns, k * moved, SMALL_COV, is_keyframe=False))
    stamp_ns = round(2.6 * SECOND_NS)
    pose, later = estimator.pose_at(stamp_ns), estimator.pose_at(stamp_ns + SECOND_NS // 100)
    assert pose is not None
    assert later is not None
    assert pose.velocity is not None
    assert pose.velocity_cov is not None
    by_poses = (later.T_map_body - pose.T_map_body)[:3, 3] / 0.01
    np.testing.assert_allclose(pose.velocity, by_poses, atol=1e-9)
    # It has followed the increments, of which each leads 4.5 cm further in a tenth of a second.
    assert np.hypot(*pose.velocity[:2]) == pytest.approx(0.45, rel=0.25)
    assert_is_covariance(pose.velocity_cov)
    # White acceleration of density 0.5 m/s^2/sqrt(Hz) makes it less certain with time, the height apart.
    assert later.velocity_cov is not None
    grown = np.diag([0.25 * 0.01, 0.25 * 0.01, 0.0])
    np.testing.assert_allclose(later.velocity_cov - pose.velocity_cov, grown, atol=1e-9)


@EVERY_ESTIMATOR
@pytest.mark.parametrize(
    "late",
    [
        good_ranges(SECOND_NS),
        PoseIncrement(0, SECOND_NS, np.array([0.1, 0.0, 0.0]), SMALL_COV, is_keyframe=True),
        PoseIncrement(SECOND_NS, SECOND_NS, np.zeros(3), SMALL_COV, is_keyframe=True),
    ],
    ids=["ranges", "increment", "founding increment"],
)
def test_late_measurements_are_refused_and_change_nothing(name: str, late: Measurement) -> None:
    if hasattr(estimator_config_class(name)(), "lag"):  # a window takes what is late, not what is before it
        late = replace(late, stamp_ns=-HOUR_NS)
    estimator, undisturbed = started(name), started(name)
    report = estimator.update(late)
    assert_report_fits(report, late)
    assert set(report.verdicts) <= {Verdict.LATE, Verdict.NOT_USED}
    for measurement in (
        good_ranges(2 * SECOND_NS + 1),
        PoseIncrement(2 * SECOND_NS, 2 * SECOND_NS + 2, np.zeros(3), SMALL_COV, is_keyframe=False),
    ):
        assert run(estimator, [measurement]) == run(undisturbed, [measurement])


@EVERY_ESTIMATOR
def test_some_measurement_is_accepted(name: str) -> None:
    estimator = make(name)
    verdicts = [verdict for m in standing_robot() for verdict in estimator.update(m).verdicts]
    assert set(verdicts) <= {Verdict.ACCEPTED, Verdict.NOT_USED}
    assert Verdict.ACCEPTED in verdicts


@EVERY_ESTIMATOR
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 0.0, -5.0])
def test_impossible_ranges_are_never_accepted_and_move_nothing(name: str, value: float) -> None:
    estimator, undisturbed = started(name), started(name)
    report = estimator.update(range_frame(2 * SECOND_NS, list(SETUP.anchors), [value] * 4))
    assert set(report.verdicts) <= {Verdict.IMPOSSIBLE, Verdict.NOT_USED}
    stamp_ns = 2 * SECOND_NS + 1000
    assert written(estimator.pose_at(stamp_ns)) == written(undisturbed.pose_at(stamp_ns))


@EVERY_ESTIMATOR
def test_unknown_anchors_are_never_accepted(name: str) -> None:
    report = started(name).update(range_frame(2 * SECOND_NS, [0, 9, -1], [3.0, 4.0, 5.0]))
    assert set(report.verdicts) <= {Verdict.UNKNOWN_ANCHOR, Verdict.NOT_USED}


@EVERY_ESTIMATOR
def test_empty_frame_has_no_verdicts(name: str) -> None:
    assert make(name).update(range_frame(0, [], [])).verdicts == ()


@EVERY_ESTIMATOR
@pytest.mark.parametrize(
    "measurement",
    [
        Scan(2 * SECOND_NS, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)),
        Scan(2 * SECOND_NS, np.zeros(2), np.ones(2), np.array([0.0, 0.1]), np.zeros(2)),
        ImuSample(2 * SECOND_NS, np.full(3, np.nan), np.zeros(3)),
        Attitude(2 * SECOND_NS, np.zeros(4)),
        LandmarkFrame(2 * SECOND_NS, np.array([0, 1]), np.ones(2), np.zeros(2), 0.03, 0.01),
    ],
    ids=["empty scan", "scan", "imu", "attitude", "landmarks"],
)
def test_other_sensors_get_one_verdict(name: str, measurement: Measurement) -> None:
    estimator = started(name)
    assert len(estimator.update(measurement).verdicts) == 1
    pose = estimator.pose_at(2 * SECOND_NS)
    assert pose is not None
    assert_pose_is_sound(pose, 2 * SECOND_NS)


@EVERY_ESTIMATOR
def test_what_an_estimator_does_not_take_changes_nothing(name: str) -> None:
    estimator, undisturbed = started(name), started(name)
    taken = taken_by(estimator)
    assert taken is None or RangeFrame in taken
    now_ns, zeros = 2 * SECOND_NS + 1000, np.zeros(3)
    others: list[Measurement] = [
        ImuSample(now_ns, zeros, np.array([0.0, 0.0, 9.81])),
        Attitude(now_ns, np.array([1.0, 0.0, 0.0, 0.0])),
        Height(now_ns, 1.0, 0.1),
        LoopClosure(0, 2 * SECOND_NS, zeros, SMALL_COV),
        Scan(now_ns, np.arange(3.0), np.ones(3), 1e-9 * np.arange(3.0), np.zeros(3)),
    ]
    idle = [m for m in others if taken is not None and type(m) not in taken]
    for measurement in idle:
        assert estimator.update(measurement).verdicts == (Verdict.NOT_USED,)
    following: list[Measurement] = [
        good_ranges(now_ns + 1000),
        PoseIncrement(2 * SECOND_NS, now_ns + 2000, zeros, SMALL_COV, False),
    ]
    assert run(estimator, following) == run(undisturbed, following)


@pytest.mark.parametrize(("motion", "uses"), [("imu", True), ("increments", False)])
@pytest.mark.parametrize("name", ["pf", "pf_ibas", "pf_ibas_graph"])
def test_inertial_samples_are_taken_by_those_whose_motion_they_tell(
    name: str, motion: str, uses: bool
) -> None:
    config = estimator_config_class(name).model_validate({"motion": motion})
    for relocation in (None, Recovering.Config()):
        taken = taken_by(make_estimator(name, config, SETUP, relocation))
        assert taken is not None
        assert (ImuSample in taken) is uses
        assert {RangeFrame, PoseIncrement, Scan} <= taken
        assert (LoopClosure in taken) is (name == "pf_ibas_graph")
