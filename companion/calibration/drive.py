"""Poses of a drive, range biases and the tag's place and clock, found together from ranges and LiDAR.

Unknown are the poses of the odometry's keyframes, which its increments tie together, and what is to be
calibrated. Between scans the tag moves in a straight line. Gauss-Newton; blocked ranges are weighed down by
Cauchy's weights first and left out at the end.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array

from companion.calibration.ranges import AnchorFit, Calibration, Ranges, trim_limit
from companion.calibration.recording import Recording
from companion.config import Config
from companion.errors import UserError
from estimators.geometry import compose, wrap_angle
from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray, PoseIncrement
from estimators.models.motion import increment
from estimators.models.range_bias import RangeBias

_RANGE_SIGMA = 0.1
_ROUNDS = 20
_BLOCK_NS = 10**9


@immutable
class _Odometry:
    """One unbroken stretch of odometry.

    Attributes:
        steps: increments from keyframe to keyframe.
        scan_ns: (S,) stamps, ascending; the first is that of the first keyframe.
        keyframe: (S,) index of the keyframe that each scan was matched to.
        from_keyframe: (S, 3) pose of each scan in its keyframe.
    """

    steps: list[PoseIncrement]
    scan_ns: IntArray
    keyframe: IntArray
    from_keyframe: FloatArray


@immutable
class _Sights:
    """Ranges during that stretch, a row each.

    Attributes:
        stamps_ns: (N,).
        anchor: (N,) index into the site's anchors.
        measured: (N,) [m].
    """

    stamps_ns: IntArray
    anchor: IntArray
    measured: FloatArray


@immutable
class _State:
    """Unknowns.

    Attributes:
        keyframes: (K, 3) poses, map frame.
        biases: (A,) of the anchors' ranges [m].
        arm: (2,) tag in the body frame [m].
        delay: how late range frames are stamped, against scans [s].
    """

    keyframes: FloatArray
    biases: FloatArray
    arm: FloatArray
    delay: float

    def moved(self, step: FloatArray) -> "_State":
        """State after a step of all unknowns, in the order of the attributes."""
        k, a = self.keyframes.size, len(self.biases)
        keyframes = self.keyframes + step[:k].reshape(-1, 3)
        return _State(
            keyframes,
            self.biases + step[k : k + a],
            self.arm + step[k + a : k + a + 2],
            self.delay + float(step[k + a + 2]),
        )


@dataclass(frozen=True, slots=True)
class Mounting:
    """Place and clock of the tag, as a drive shows them.

    Attributes:
        arm: x and y of the tag in the body frame [m].
        arm_sigma: their standard deviations [m].
        delay: how late range frames are stamped, against scans [s].
        delay_sigma: standard deviation of it [s].
    """

    arm: tuple[float, float]
    arm_sigma: tuple[float, float]
    delay: float
    delay_sigma: float


def calibrate_on_drive(recording: Recording, config: Config) -> Calibration:
    """Range biases from a drive with LiDAR, the tag where the site says.

    Raises:
        UserError: the recording has no odometry, or too few ranges beside it.
    """
    drive = _Drive(recording, config, with_mounting=False)
    state, cov = drive.solve()
    return drive.calibration(state, cov)


def mounting_on_drive(recording: Recording, config: Config) -> Mounting:
    """Lever arm of the tag and delay of its stamps from a drive with LiDAR, range biases along with them.

    Raises:
        UserError: the recording has no odometry, or too few ranges beside it.
    """
    drive = _Drive(recording, config, with_mounting=True)
    state, cov = drive.solve()
    sigmas = np.sqrt(np.diag(cov)[-3:]).tolist()
    x, y = state.arm.tolist()
    return Mounting((x, y), (sigmas[0], sigmas[1]), state.delay, sigmas[2])


class _Drive:
    """Least squares over a recording.

    Args:
        recording: with increments.
        config: of its site; tells anchors, start and where the tag should sit.
        with_mounting: look for the tag's place and delay, too.
    """

    def __init__(self, recording: Recording, config: Config, with_mounting: bool) -> None:
        self._odometry = _longest_stretch(recording.increments)
        self._anchor_ids = list(config.anchors)
        self._anchors = np.array(list(config.anchors.values()))
        self._sights = _sights(recording, self._anchor_ids, self._odometry.scan_ns)
        self._start_ns = recording.start_ns
        setup = config.setup()
        self._start = setup.start
        self._tag_height = setup.height + float(setup.tag_in_body[2])
        keyframes = [self._start.pose]
        for step in self._odometry.steps:
            keyframes.append(compose(keyframes[-1], step.increment))
        self._initial = _State(
            np.array(keyframes), np.zeros(len(self._anchors)), setup.tag_in_body[:2].copy(), 0.0
        )
        self._free = np.ones(3 * len(keyframes) + len(self._anchors) + 3, dtype=bool)
        self._free[-3:] = with_mounting
        # An anchor that was not heard has no bias to be found.
        heard = np.bincount(self._sights.anchor, minlength=len(self._anchors)) > 0
        self._free[3 * len(keyframes) : -3] = heard
        self._used = np.ones(len(self._sights.measured), dtype=bool)

    def solve(self) -> tuple[_State, FloatArray]:
        """State and covariance of all unknowns; zero where they were held."""
        state = self._initial
        for _ in range(_ROUNDS):
            errors, _ = self._range_errors(state)
            # What blocks a range lengthens it: long ones are doubted sooner than short ones.
            scale = np.where(errors > 0.0, 1.0, 3.0) * _RANGE_SIGMA
            state, _ = self._step(state, 1.0 / (1.0 + (errors / scale) ** 2))
        limit = np.inf
        for _ in range(_ROUNDS):
            errors, _ = self._range_errors(state)
            limit = min(limit, trim_limit(errors))
            self._used = np.abs(errors) <= limit
            state, information = self._step(state, self._used.astype(np.float64))
        errors, _ = self._range_errors(state)
        cov = np.zeros((len(self._free), len(self._free)))
        cov[np.ix_(self._free, self._free)] = np.linalg.inv(information)
        return state, cov * self._inflation(errors)

    def calibration(self, state: _State, cov: FloatArray) -> Calibration:
        """Biases of the state in the form that a calibration against known positions has."""
        sights = self._sights
        errors, _ = self._range_errors(state)
        times = (sights.stamps_ns - self._start_ns) * 1e-9
        distances = sights.measured - errors - state.biases[sights.anchor]
        first = state.keyframes.size
        fits: dict[int, AnchorFit] = {}
        for i, anchor_id in enumerate(self._anchor_ids):
            own = sights.anchor == i
            if own.any():
                fits[anchor_id] = AnchorFit(
                    RangeBias(float(state.biases[i]), 0.0, float(distances[own].mean())),
                    float(np.sqrt(cov[first + i, first + i])),
                    0.0,
                    float(errors[own & self._used].std()),
                    self._used[own],
                    Ranges(times[own], sights.measured[own], distances[own]),
                )
        rows = [first + i for i, anchor_id in enumerate(self._anchor_ids) if anchor_id in fits]
        return Calibration(
            common=float(np.mean([fit.bias.constant for fit in fits.values()])),
            common_sigma=float(np.sqrt(cov[np.ix_(rows, rows)].sum())) / len(rows),
            anchors=fits,
        )

    def _inflation(self, errors: FloatArray) -> float:
        """Variance of the ranges against the assumed one, likeness of errors within a second included."""
        used = errors[self._used]
        blocks = (self._sights.stamps_ns[self._used] // _BLOCK_NS) * len(self._anchors)
        index = np.unique(blocks + self._sights.anchor[self._used], return_inverse=True)[1]
        sums = np.bincount(index, used)
        return float((sums**2).sum() / len(used)) / _RANGE_SIGMA**2

    def _step(self, state: _State, weights: FloatArray) -> tuple[_State, FloatArray]:
        """State after one Gauss-Newton step, and the information (F, F) on the free unknowns."""
        errors, J = self._range_errors(state)
        scaled = J.multiply((weights / _RANGE_SIGMA**2)[:, None]).tocsr()
        H = (J.T @ scaled).toarray()
        g = scaled.T @ errors
        start_information = np.diag(1.0 / self._start.sigma**2)
        off = self._start.pose - state.keyframes[0]
        off[2] = wrap_angle(off[2])
        H[:3, :3] += start_information
        g[:3] += start_information @ off
        for k, step in enumerate(self._odometry.steps):
            value, by_reference, by_pose = increment(state.keyframes[k], state.keyframes[k + 1])
            residual = step.increment - value
            residual[2] = wrap_angle(residual[2])
            both = np.hstack([by_reference, by_pose])
            weighted = both.T @ np.linalg.inv(step.cov)
            rows = slice(3 * k, 3 * k + 6)
            H[rows, rows] += weighted @ both
            g[rows] += weighted @ residual
        information = H[np.ix_(self._free, self._free)]
        change = np.zeros(len(self._free))
        change[self._free] = np.linalg.solve(information, g[self._free])
        return state.moved(change), information

    def _range_errors(self, state: _State) -> tuple[FloatArray, coo_array]:
        """Measured minus predicted ranges (N,), and the derivative of the predicted by all unknowns."""
        sights, odometry = self._sights, self._odometry
        count = len(sights.measured)
        scan_times = (odometry.scan_ns - odometry.scan_ns[0]) * 1e-9
        times = (sights.stamps_ns - odometry.scan_ns[0]) * 1e-9 - state.delay
        before = np.clip(np.searchsorted(scan_times, times, side="right") - 1, 0, len(scan_times) - 2)
        gap = scan_times[before + 1] - scan_times[before]
        share = (times - scan_times[before]) / gap

        tag, turned, by_arm = self._tags(state)
        position = tag[before] + share[:, None] * (tag[before + 1] - tag[before])
        offset = position - self._anchors[sights.anchor, :2]
        height = self._tag_height - self._anchors[sights.anchor, 2]
        distance = np.sqrt((offset**2).sum(axis=1) + height**2)
        errors = sights.measured - distance - state.biases[sights.anchor]
        unit = offset / distance[:, None]

        rows, columns, values = [], [], []

        def put(column: IntArray, value: FloatArray) -> None:
            rows.append(np.arange(count))
            columns.append(column)
            values.append(value)

        for scan, part in ((before, 1.0 - share), (before + 1, share)):
            first = 3 * odometry.keyframe[scan]
            put(first, part * unit[:, 0])
            put(first + 1, part * unit[:, 1])
            put(first + 2, part * (unit * turned[scan]).sum(axis=1))
        put(state.keyframes.size + sights.anchor, np.ones(count))
        arm_column = len(self._free) - 3
        by_own_arm = by_arm[before] + share[:, None, None] * (by_arm[before + 1] - by_arm[before])
        along_arm = np.einsum("ni,nij->nj", unit, by_own_arm)
        put(np.full(count, arm_column), along_arm[:, 0])
        put(np.full(count, arm_column + 1), along_arm[:, 1])
        velocity = (tag[before + 1] - tag[before]) / gap[:, None]
        put(np.full(count, arm_column + 2), -(unit * velocity).sum(axis=1))
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return errors, coo_array(entries, shape=(count, len(self._free)))

    def _tags(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Tag (S, 2) at every scan, its derivative by the keyframe's yaw (S, 2) and by the arm (S, 2, 2)."""
        keyframe, own = state.keyframes[self._odometry.keyframe], self._odometry.from_keyframe
        in_keyframe = own[:, :2] + np.einsum("nij,j->ni", _rotations(own[:, 2]), state.arm)
        turned = np.einsum("nij,nj->ni", _rotations(keyframe[:, 2]), in_keyframe)
        by_yaw = np.column_stack([-turned[:, 1], turned[:, 0]])
        return keyframe[:, :2] + turned, by_yaw, _rotations(keyframe[:, 2] + own[:, 2])


def _rotations(yaws: FloatArray) -> FloatArray:
    """Rotation matrices (N, 2, 2)."""
    c, s = np.cos(yaws), np.sin(yaws)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _longest_stretch(increments: list[PoseIncrement]) -> _Odometry:
    """The longest time over which every increment starts at a keyframe that is known."""
    stretches: list[list[PoseIncrement]] = []
    for each in increments:
        if each.from_stamp_ns == each.stamp_ns:
            stretches.append([each])
        elif stretches:
            stretches[-1].append(each)
    longest = max(stretches, key=len, default=[])
    if len(longest) < 3:
        raise UserError(
            "the log holds no LiDAR odometry: drive with the LiDAR running, or use another reference"
        )
    index_of = {longest[0].stamp_ns: 0}
    steps: list[PoseIncrement] = []
    keyframe, poses = [0], [np.zeros(3)]
    for each in longest[1:]:
        keyframe.append(index_of[each.from_stamp_ns])
        poses.append(each.increment)
        if each.is_keyframe:
            steps.append(each)
            index_of[each.stamp_ns] = len(steps)
    scan_ns = np.array([each.stamp_ns for each in longest], dtype=np.int64)
    return _Odometry(steps, scan_ns, np.array(keyframe, dtype=np.int64), np.array(poses))


def _sights(recording: Recording, anchor_ids: list[int], scan_ns: IntArray) -> _Sights:
    rows = [
        (frame.stamp_ns, anchor_ids.index(anchor_id), measured)
        for frame in recording.range_frames
        if scan_ns[0] < frame.stamp_ns < scan_ns[-1]
        for anchor_id, measured in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True)
        if anchor_id in anchor_ids and 0.0 < measured < np.inf
    ]
    if len(rows) < 100:
        raise UserError(f"only {len(rows)} ranges while the LiDAR's odometry ran, at least 100 are needed")
    stamps, anchors, measured = zip(*rows, strict=True)
    return _Sights(np.array(stamps, dtype=np.int64), np.array(anchors, dtype=np.int64), np.array(measured))
