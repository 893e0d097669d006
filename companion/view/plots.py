"""The time series of a scene: errors and sigmas, residuals and NIS, ages, rates and latency."""

from itertools import cycle

import numpy as np
import rerun as rr

from companion.config import Config
from companion.view.anchor_marks import anchor_colours
from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.palette import GREY, SENSORS, VERMILION, WHITE
from estimators import chi2
from estimators.messages import FloatArray, IntArray, PoseIncrement, RangeFrame, Scan, measurement_stamp_ns

RATE_OVER_NS = 1_000_000_000
"""Rates are counted over this time."""
_KINDS = {RangeFrame: "ranges", Scan: "scans", PoseIncrement: "increments"}


class Plots:
    """Writes time series batch by batch.

    Args:
        entities: to write to.
        config: of the site.
        colours: estimator -> colour, the primary first.
    """

    def __init__(self, entities: Entities, config: Config, colours: dict[str, int]) -> None:
        self._entities, self._config, self._colours = entities, config, colours
        self._primary = next(iter(colours))
        self._sigmas: list[FloatArray] = []
        self._misses: list[FloatArray] = []
        self._arrivals: dict[str, IntArray] = {}
        for i, colour in anchor_colours(config).items():
            style = rr.SeriesPoints(names=f"A{i}", colors=colour, markers="circle", marker_sizes=1.5)
            entities.static(f"ranges/residual/A{i}", style)
            entities.static(f"ranges/nis/A{i}", style)
        # Estimators that gate single ranges name the share that passes `range_gate`.
        share = getattr(config.estimator_config(self._primary), "range_gate", None)
        self._gate = None if share is None else chi2.ppf(share, 1)

    def send(self, batch: Batch) -> None:
        """Write a batch."""
        self._send_sigmas(batch)
        for name in batch.names:
            self._send_errors(batch, name)
        self._send_residuals(batch)
        self._send_sensors(batch)

    def send_latency(self, stamps_ns: IntArray, seconds: FloatArray) -> None:
        """Write how old poses were when they were sent."""
        self._entities.series("sensors/latency/sent", "pose when sent", VERMILION, stamps_ns, 1e3 * seconds)

    def close(self) -> None:
        """Fit the axes of errors to the primary: a jump of another estimator would leave it a flat line."""
        if not self._sigmas:
            return
        sigmas, misses = np.vstack(self._sigmas), np.vstack(self._misses)
        for i, entity in enumerate(("error/position", "error/yaw")):
            if entity in self._entities.plots:
                usual = [_percentile(sigmas[:, i], 50), _percentile(misses[:, i], 95)]
                limit = np.nanmax(usual) if np.isfinite(usual).any() else 0.0
                self._entities.plots[entity] = 2.5 * float(limit) or None

    def _send_sigmas(self, batch: Batch) -> None:
        cov = batch.tracks[self._primary].cov[batch.new]
        known = np.isfinite(cov[:, :2, :2]).all(axis=(1, 2))
        major = np.full(len(cov), np.nan)
        major[known] = 3.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(cov[known, :2, :2])[:, 1], 0.0))
        variance = np.where(np.isfinite(cov[:, 2, 2]), cov[:, 2, 2], np.nan)
        yaw = 3.0 * np.rad2deg(np.sqrt(variance))
        series = self._entities.series
        series("error/position/sigma", "3 sigma", GREY, batch.stamps_ns, major)
        series("error/yaw/sigma_above", "3 sigma", GREY, batch.stamps_ns, yaw)
        series("error/yaw/sigma_below", "-3 sigma", GREY, batch.stamps_ns, -yaw)
        self._sigmas.append(np.column_stack([major, yaw]))

    def _send_errors(self, batch: Batch, name: str) -> None:
        """Errors against truth; without truth, how far the others are from the primary."""
        series, colour = self._entities.series, self._colours[name]
        error = batch.errors(name)
        distance, yaw = np.hypot(error[:, 0], error[:, 1]), np.rad2deg(error[:, 2])
        series(f"error/position/{name}", name, colour, batch.stamps_ns, distance)
        series(f"error/yaw/{name}", name, colour, batch.stamps_ns, yaw)
        if name == self._primary:
            self._misses.append(np.column_stack([distance, np.abs(yaw)]))
        elif not batch.truths:
            apart = batch.tracks[name].pose - batch.tracks[self._primary].pose
            away = np.hypot(apart[batch.new, 0], apart[batch.new, 1])
            series(f"apart/{name}", f"{name} from {self._primary}", colour, batch.stamps_ns, away)

    def _send_residuals(self, batch: Batch) -> None:
        """Residual and NIS of each anchor, as far as the primary reports them."""
        frames = [(f, r) for f, r in batch.frames if len(r.residuals) == len(r.nis) == len(f.ranges)]
        if not frames:
            return
        ids = np.concatenate([frame.anchor_ids for frame, _ in frames])
        stamps_ns = np.repeat([f.stamp_ns for f, _ in frames], [len(f.ranges) for f, _ in frames])
        residuals = np.concatenate([report.residuals for _, report in frames])
        nis = np.concatenate([report.nis for _, report in frames])
        for i in self._config.anchors:
            self._entities.scalars(f"ranges/residual/A{i}", stamps_ns[ids == i], residuals[ids == i])
            self._entities.scalars(f"ranges/nis/A{i}", stamps_ns[ids == i], nis[ids == i])
        if self._gate is not None and len(stamps_ns):
            ends = stamps_ns[[0, -1]]
            self._entities.series("ranges/nis/gate", "gate", WHITE, ends, np.full(2, self._gate))
            # Blocked ranges reach hundreds; what matters is the side of the gate on which a range is.
            self._entities.plots["ranges/nis"] = 4.0 * self._gate

    def _send_sensors(self, batch: Batch) -> None:
        """How old the newest measurement of each kind was at every tick, and how many came in a second."""
        new: dict[str, tuple[list[int], list[int]]] = {}
        for i, tick in enumerate(batch.ticks):
            for outcome in tick.outcomes:
                kind = _KINDS.get(type(outcome.measurement))
                if kind is not None:
                    ticks, stamps = new.setdefault(kind, ([], []))
                    ticks.append(i)
                    stamps.append(measurement_stamp_ns(outcome.measurement))
        colours = dict(zip(_KINDS.values(), cycle(SENSORS), strict=False))
        for kind in [*self._arrivals, *(kind for kind in new if kind not in self._arrivals)]:
            ticks, stamps = new.get(kind, ([], []))
            earlier = self._arrivals.get(kind, np.empty(0, np.int64))
            stamps_ns = np.concatenate([earlier, np.array(stamps, np.int64)])
            count = len(earlier) + np.searchsorted(ticks, np.arange(len(batch.ticks)), side="right")
            old = np.searchsorted(stamps_ns, batch.stamps_ns - RATE_OVER_NS, side="right")
            age = np.where(count > 0, (batch.stamps_ns - stamps_ns[count - 1]) * 1e-6, np.nan)
            rate = np.where(count > 0, np.maximum(count - old, 0), np.nan)
            self._entities.series(f"sensors/age/{kind}", kind, colours[kind], batch.stamps_ns, age)
            self._entities.series(f"sensors/rate/{kind}", kind, colours[kind], batch.stamps_ns, rate)
            self._arrivals[kind] = stamps_ns[min(old[-1], len(stamps_ns) - 1) :]


def _percentile(values: FloatArray, share: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.percentile(values, share)) if len(values) else np.nan
