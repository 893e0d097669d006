"""What the LiDAR front end knows the room by, on the map: corners and poles of the EKF-SLAM."""

import numpy as np
import rerun as rr

from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.palette import YELLOW, screen
from estimators.geometry import transform_each
from estimators.messages import Scan

_PATH = "map/landmarks"


def send_landmarks(entities: Entities, batch: Batch) -> None:
    """Draw the landmarks as they were known after each scan, seen from the primary's pose at its end.

    Args:
        entities: to write to.
        batch: of ticks.
    """
    ends_ns, clouds = [], []
    for tick in batch.ticks:
        scans = [o.measurement for o in tick.outcomes if isinstance(o.measurement, Scan)]
        if scans and len(tick.landmarks):
            ends_ns.append(scans[-1].end_stamp_ns)
            clouds.append(tick.landmarks)
    if not clouds:
        return
    stamps_ns, counts = np.array(ends_ns), [len(cloud) for cloud in clouds]
    row = np.repeat(np.arange(len(clouds)), counts)
    places = transform_each(batch.tracks[batch.names[0]].at(stamps_ns)[row], np.vstack(clouds))
    known = np.isfinite(places).all(axis=1)
    entities.style(_PATH, rr.Points2D.from_fields(colors=YELLOW, radii=screen(4.0), draw_order=16.0))
    columns = rr.Points2D.columns(positions=places[known])
    entities.columns(_PATH, stamps_ns, columns.partition(np.bincount(row[known], minlength=len(clouds))))
