"""Writes a scene's entities into a Rerun stream, each value at its capture time and its frame number."""

import numpy as np
import rerun as rr

from companion.view.palette import screen
from estimators.messages import FloatArray, IntArray

TIME, FRAME = "time", "frame"


class Entities:
    """The entities of one run in a stream.

    Args:
        stream: of Rerun.
        start_ns: of the run; time and frames count from here.
        rate: ticks a second; a frame is one tick.
        root: entity below which all of the run is; empty when it is the only one.

    Attributes:
        plots: entity of a plot -> upper end of its y axis, None to fit everything.
    """

    def __init__(self, stream: rr.RecordingStream, start_ns: int, rate: float, root: str = "") -> None:
        self.stream = stream
        self.root = root
        self.plots: dict[str, float | None] = {}
        self._start_ns = start_ns
        self._period_ns = 1e9 / rate
        self._styled: set[str] = set()

    def static(self, path: str, archetype: rr.AsComponents) -> None:
        """Something that holds for all times."""
        self.stream.log(self.root + path, archetype, static=True)

    def style(self, path: str, archetype: rr.AsComponents) -> None:
        """What an entity looks like, said once."""
        if path not in self._styled:
            self._styled.add(path)
            self.static(path, archetype)

    def seconds(self, stamp_ns: int) -> float:
        """Time since the start of the run [s]."""
        return (stamp_ns - self._start_ns) * 1e-9

    def columns(self, path: str, stamps_ns: IntArray, columns: rr.ComponentColumnList) -> None:
        """Rows of an entity; the frame of a row is the tick that followed its time."""
        if len(stamps_ns):
            since = stamps_ns - self._start_ns
            frames = np.ceil(since / self._period_ns).astype(np.int64)
            times = [
                rr.TimeColumn(TIME, duration=since.astype("timedelta64[ns]")),
                rr.TimeColumn(FRAME, sequence=frames),
            ]
            self.stream.send_columns(self.root + path, times, columns)

    def series(self, path: str, name: str, colour: int, stamps_ns: IntArray, values: FloatArray) -> None:
        """A line of a plot, broken where a value is NaN; nothing at all where every value is."""
        if np.isfinite(values).any() or path in self._styled:
            # Peaks are what one looks for; an average over the pixels of a wide view would hide them.
            style = rr.SeriesLines(names=name, colors=colour, widths=1.0, aggregation_policy="MinMax")
            self.style(path, style)
            self.scalars(path, stamps_ns, values)

    def scalars(self, path: str, stamps_ns: IntArray, values: FloatArray) -> None:
        """Values of a plot."""
        if np.isfinite(values).any():
            self.plots.setdefault(path.rpartition("/")[0], None)
        if path.rpartition("/")[0] in self.plots:
            self.columns(path, stamps_ns, rr.Scalars.columns(scalars=values))

    def points(
        self, path: str, stamps_ns: IntArray, xy: FloatArray, colour: int, size: float, layer: float
    ) -> None:
        """A dot (N, 2) [m] on the map that moves; it vanishes where a coordinate is NaN."""
        known = np.isfinite(xy).all(axis=1)
        self.style(path, rr.Points2D.from_fields(colors=colour, radii=screen(size), draw_order=layer))
        self.columns(path, stamps_ns, rr.Points2D.columns(positions=xy[known]).partition(known))

    def strips(
        self, path: str, stamps_ns: IntArray, xy: FloatArray, colour: int, width: float, layer: float
    ) -> None:
        """A way on the map in steps: (N, 2) [m], the first one where the first step begins; NaN breaks it."""
        if len(xy) > 1:
            steps = np.stack([xy[:-1], xy[1:]], axis=1).astype(np.float32)
            known = np.isfinite(steps).all(axis=(1, 2))
            self.style(
                path, rr.LineStrips2D.from_fields(colors=colour, radii=screen(width), draw_order=layer)
            )
            self.columns(path, stamps_ns[1:][known], rr.LineStrips2D.columns(strips=steps[known]))
