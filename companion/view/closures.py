"""Loop closures on the map: lines from where the robot was to the place that it came back to."""

import numpy as np
import rerun as rr

from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.palette import GREY, VERDICTS, rgba, screen
from estimators.base import Verdict
from estimators.geometry import compose, inverse


def send_closures(entities: Entities, batch: Batch) -> None:
    """Draw the closures of a batch, for every estimator that has a use for them.

    The place is drawn as seen from the newer pose: where the line ends beside the track, closure and track
    disagree. So it needs no memory of the place, which may lie before the part that is shown.

    Args:
        entities: to write to.
        batch: of ticks.
    """
    for name in batch.names:
        told = [
            (c, r[name].verdicts[0]) for c, r in batch.closures if Verdict.NOT_USED not in r[name].verdicts
        ]
        if not told:
            continue
        stamps_ns = np.array([closure.stamp_ns for closure, _ in told])
        poses = batch.tracks[name].at(stamps_ns)
        places = [compose(pose, inverse(c.increment)) for pose, (c, _) in zip(poses, told, strict=True)]
        lines = np.stack([poses[:, :2], np.array(places)[:, :2]], axis=1)
        known = np.isfinite(lines).all(axis=(1, 2))
        path = f"map/estimate/{name}/closures"
        entities.style(path, rr.LineStrips2D.from_fields(radii=screen(2.0), draw_order=43.0))
        columns = rr.LineStrips2D.columns(
            strips=lines[known].astype(np.float32),
            colors=rgba(VERDICTS.get(verdict, GREY) for _, verdict in told)[known],
            labels=np.array(["closure" if v.is_used else f"closure: {v}" for _, v in told])[known],
        )
        entities.columns(path, stamps_ns, columns.partition(known.astype(np.int64)))
