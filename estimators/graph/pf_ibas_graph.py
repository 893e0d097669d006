"""The full method of huang2024: PF-IBAS poses each step and refuses blocked ranges, a graph follows."""

from dataclasses import replace

from estimators.base import Report, Setup, Sketch
from estimators.geometry import wrap_angle
from estimators.graph.smoother import GraphSmoother
from estimators.messages import FloatArray, LandmarkFrame, Measurement, RangeFrame
from estimators.pf_ibas import PfIbas


class PfIbasGraph(GraphSmoother):
    """Fixed-lag smoother behind a particle filter.

    The filter takes every measurement first. A range that it refuses or weighs down does not get into the
    graph, and its pose is where the search for a new node begins. What is given out is the graph's.

    Source: huang2024 Eq. (15)-(38).
    """

    class Config(PfIbas.Config, GraphSmoother.Config):  # type: ignore[misc]  # pydantic's plugin
        """Settings of `pf_ibas_graph`."""

    def __init__(self, config: Config, setup: Setup) -> None:
        self._filter = PfIbas(config, setup)
        super().__init__(config, setup)
        self._gate = self._filter.gate

    @property
    def takes(self) -> frozenset[type[Measurement]]:
        """What filter or graph takes."""
        return super().takes | self._filter.takes

    def reset(self) -> None:
        """Stand at the start again, filter and graph."""
        self._filter.reset()
        super().reset()

    def start_at(self, stamp_ns: int, pose: FloatArray, cov: FloatArray) -> None:
        """Set filter and graph."""
        self._filter.start_at(stamp_ns, pose, cov)
        super().start_at(stamp_ns, pose, cov)

    def update(self, measurement: Measurement) -> Report:
        """Take one measurement, the filter first; what comes late the graph takes alone."""
        self._said = self._filter.update(measurement)
        return super().update(measurement)

    def sketch(self) -> Sketch:
        """The filter's particles and the graph's window."""
        return replace(super().sketch(), particles=self._filter.sketch().particles)

    def _judge_newest(self, frame: RangeFrame | LandmarkFrame) -> Report:
        judged = self._filter.judged
        if judged is None or judged.frame is not frame:
            return super()._judge_newest(frame)
        rows = self._judging.believed_ranges(judged, self._setup.arm(frame.tag_id), weighed=False)
        return self._taken(frame.stamp_ns, "ranges", rows, self._said)

    def _guess(self, stamp_ns: int) -> FloatArray:
        # The filter has taken what is there: its mean is of this instant.
        state, pose = super()._guess(stamp_ns), self._filter.mean
        turn = wrap_angle(float(pose[2] - state[0, 2]))
        state[0] = pose[0], pose[1], state[0, 2] + turn
        return state
