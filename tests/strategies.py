"""Hypothesis strategies shared by tests: poses, and measurement streams that no honest sensor would send."""

import numpy as np
from hypothesis import strategies as st

from estimators.base import Setup, Start
from estimators.messages import (
    Attitude,
    FloatArray,
    ImuSample,
    LandmarkFrame,
    Measurement,
    PoseIncrement,
    RangeFrame,
    Scan,
)

NAN = float("nan")
INF = float("inf")

SETUP = Setup(
    anchors={
        1: np.array([0.0, 0.0, 2.5]),
        2: np.array([8.0, 0.2, 2.3]),
        3: np.array([7.8, 6.0, 2.6]),
        4: np.array([0.1, 5.9, 2.4]),
    },
    tag_in_body=np.array([0.12, -0.05, 0.3]),
    start=Start(np.array([3.5, 2.8, 0.4]), np.array([0.2, 0.2, 0.1])),
    height=0.3,
    height_sigma=0.02,
    level_sigma=0.03,
)
"""A room of 8 m by 6 m with an anchor in every corner and a tag off the body's origin."""

HOUR_NS = 3_600 * 10**9
AGE_NS = 10**18
"""31 years: as far off as a wrong clock says."""

coordinates = st.floats(-50.0, 50.0)
tiny = st.floats(-1e-9, 1e-9)
angles = st.one_of(
    st.floats(-np.pi, np.pi),
    tiny,
    tiny.map(lambda angle: np.pi + angle),
    tiny.map(lambda angle: -np.pi + angle),
    st.sampled_from([0.0, np.pi, -np.pi]),
)
"""Headings [rad], often next to zero and to the seam at half a turn."""


def _vector(*parts: float) -> FloatArray:
    return np.array(parts, dtype=np.float64)


poses = st.one_of(st.builds(_vector, coordinates, coordinates, angles), st.builds(_vector, tiny, tiny, tiny))
"""Planar motions (3,), often next to the identity."""


def range_frame(stamp_ns: int, anchor_ids: list[int], ranges: list[float]) -> RangeFrame:
    """A frame without powers."""
    ids, values = np.array(anchor_ids, dtype=np.int64), np.array(ranges, dtype=np.float64)
    missing = np.full(len(ranges), np.nan)
    return RangeFrame(stamp_ns, 7, ids, values, missing, missing)


# As far as 24 bits of millimetres reach, both ways, and what is no number.
_ranges = st.one_of(
    st.floats(0.0, 12.0), st.floats(-8.4e3, 8.4e3), st.sampled_from([NAN, INF, -INF, 0.0, -0.0, -1.0])
)
_anchor_ids = st.one_of(st.sampled_from(sorted(SETUP.anchors)), st.sampled_from([0, 5, 255, -1, 2**40]))


@st.composite
def range_frames(draw: st.DrawFn, stamp_ns: int) -> RangeFrame:
    """Frames with unknown and repeated anchors and impossible ranges; or the room's own, disturbed."""
    rows = draw(st.lists(st.tuples(_anchor_ids, _ranges), max_size=6))
    return range_frame(stamp_ns, [row[0] for row in rows], [row[1] for row in rows])


@st.composite
def pose_increments(draw: st.DrawFn, stamp_ns: int, reference_stamps: list[int]) -> PoseIncrement:
    """Increments from known and unknown keyframes, possible, jumping or not numbers at all."""
    component = st.one_of(st.floats(-0.3, 0.3), st.floats(-1e6, 1e6), st.sampled_from([NAN, INF]))
    factor = np.array(draw(st.lists(st.floats(-0.1, 0.1), min_size=9, max_size=9))).reshape(3, 3)
    cov: FloatArray = factor @ factor.T + draw(st.sampled_from([1e-10, 1e-6, 1e-2, 1e4])) * np.eye(3)
    cov *= draw(st.sampled_from([1.0, 1.0, 0.0, -1.0]))
    if draw(st.booleans()):
        cov[draw(st.integers(0, 2)), draw(st.integers(0, 2))] = draw(st.sampled_from([NAN, INF, -1.0]))
    return PoseIncrement(
        draw(st.sampled_from([stamp_ns, stamp_ns - 7, *reference_stamps])),
        stamp_ns,
        _vector(draw(component), draw(component), draw(component)),
        cov,
        draw(st.booleans()),
    )


@st.composite
def other_measurements(draw: st.DrawFn, stamp_ns: int) -> Measurement:
    """Scans, inertial samples, attitudes and landmarks with anything in them."""
    value = st.floats(allow_nan=True, allow_infinity=True)
    triple = st.lists(value, min_size=3, max_size=3)
    kind = draw(st.integers(0, 3))
    if kind == 0:
        return ImuSample(stamp_ns, np.array(draw(triple)), np.array(draw(triple)))
    if kind == 1:
        return Attitude(stamp_ns, np.array([draw(value), *draw(triple)]))
    count = draw(st.integers(0, 5))
    ranges = np.array(draw(st.lists(value, min_size=count, max_size=count)))
    if kind == 2:
        ids = np.array(draw(st.lists(_anchor_ids, min_size=count, max_size=count)), dtype=np.int64)
        bearings = np.array(draw(st.lists(value, min_size=count, max_size=count)))
        return LandmarkFrame(stamp_ns, ids, ranges, bearings, draw(value), draw(value))
    return Scan(stamp_ns, np.linspace(0.0, 6.0, count), ranges, np.linspace(0.0, 0.1, count), np.zeros(count))


@st.composite
def hostile_streams(draw: st.DrawFn) -> list[Measurement]:
    """Measurements of every kind, some late, some after an hour of silence."""
    step = st.one_of(
        st.integers(0, 200_000_000), st.integers(-2_000_000_000, 0), st.sampled_from([0, 1, HOUR_NS])
    )
    stamp_ns = draw(st.sampled_from([0, 10**9, -(10**9), 10**18]))
    stream: list[Measurement] = []
    keyframes: list[int] = []
    for _ in range(draw(st.integers(1, 12))):
        kind = draw(st.integers(0, 3))
        if kind <= 1:
            stream.append(draw(range_frames(stamp_ns)))
        elif kind == 2:
            stream.append(draw(pose_increments(stamp_ns, keyframes[-2:])))
            keyframes.append(stamp_ns)
        else:
            stream.append(draw(other_measurements(stamp_ns)))
        stamp_ns += draw(step)
    return stream
