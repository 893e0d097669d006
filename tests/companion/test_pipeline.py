"""What reaches which estimator."""

import numpy as np

from companion.pipeline import Pipeline
from estimators.base import Estimator, Report, Taken, Verdict
from estimators.messages import Attitude, ImuSample, Measurement, PoseEstimate, PoseIncrement, RangeFrame
from tests.strategies import range_frame

SAMPLE = ImuSample(5, np.zeros(3), np.zeros(3))
ATTITUDE = Attitude(6, np.array([1.0, 0.0, 0.0, 0.0]))
FRAME = range_frame(7, [1], [2.0])


class Listener:
    """An estimator that remembers what it was given."""

    def __init__(self) -> None:
        self.given: list[Measurement] = []

    def reset(self) -> None:
        self.given.clear()

    def update(self, measurement: Measurement) -> Report:
        self.given.append(measurement)
        return Report((Verdict.ACCEPTED,))

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:  # noqa: ARG002
        return None


class Picky(Listener):
    """One that says what it takes."""

    def __init__(self, *taken: type[Measurement]) -> None:
        super().__init__()
        self._taken = frozenset(taken)

    @property
    def takes(self) -> Taken:
        return self._taken


class NoMotion:
    """A front end that only listens."""

    def __init__(self) -> None:
        self.given: list[Measurement] = []

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        self.given.append(measurement)
        return None


def test_estimators_get_what_they_take_and_every_outcome_has_a_report_of_each() -> None:
    listener, ranges, inertial = Listener(), Picky(RangeFrame), Picky(RangeFrame, ImuSample)
    estimators: dict[str, Estimator] = {"ranges": ranges, "listener": listener, "inertial": inertial}
    front_end = NoMotion()
    pipeline = Pipeline(front_end, estimators)
    verdicts = []
    for measurement in (SAMPLE, ATTITUDE, FRAME):
        (outcome,) = pipeline.step(measurement)
        assert outcome.measurement is measurement
        assert list(outcome.reports) == list(estimators)
        verdicts.append([report.verdicts for report in outcome.reports.values()])
    assert front_end.given == listener.given == [SAMPLE, ATTITUDE, FRAME]
    assert ranges.given == [FRAME]
    assert inertial.given == [SAMPLE, FRAME]
    used, not_used = (Verdict.ACCEPTED,), (Verdict.NOT_USED,)
    assert verdicts == [[not_used, used, used], [not_used, used, not_used], [used, used, used]]


def test_what_nobody_takes_still_is_an_outcome() -> None:
    pipeline = Pipeline(NoMotion(), {"ranges": Picky(RangeFrame)})
    (outcome,) = pipeline.step(SAMPLE)
    assert outcome.reports["ranges"].verdicts == (Verdict.NOT_USED,)
