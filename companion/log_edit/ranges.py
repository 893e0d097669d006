"""Ranges inside the frames of a LinkTrack module, changed one by one."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeAlias, cast

from drivers.linktrack_types import (
    AnchorDistances,
    AnchorFrame0,
    AoaNodeFrame0,
    AoaNodeRange,
    Frame,
    NodeFrame2,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeRange,
    Role,
    TagFrame0,
)

LEAST_RANGE = 0.001
"""A range on the wire is a whole number of millimetres, and 0 means none."""
LEAST_POWER = -127.5
"""The weakest signal that the wire can tell [dBm]."""


class Changed(NamedTuple):
    """A range after a fault.

    Attributes:
        dis: distance [m].
        rx_loss: power that everything received has less [dB].
        fp_loss: power that the first path has less [dB].
    """

    dis: float
    rx_loss: float = 0.0
    fp_loss: float = 0.0


Change: TypeAlias = Callable[[int, float], Changed | None]
"""Anchor id and distance [m] -> what becomes of it, None when the range fails."""


def change_ranges(frame: Frame, change: Change) -> Frame:
    """The frame with every range to an anchor changed; what a console measures to tags stays."""
    match frame:
        case NodeFrame2() | NodeFrame3() | NodeFrame5() | AoaNodeFrame0():
            nodes = [_node(node, change) for node in frame.nodes]
            return replace(frame, nodes=tuple(node for node in nodes if node is not None))  # type: ignore[arg-type]
        case NodeFrame4():
            tags = []
            for tag in frame.tags:
                changed = [(anchor, change(anchor.id, anchor.dis)) for anchor in tag.anchors]
                kept = tuple(anchor._replace(dis=_least(new.dis)) for anchor, new in changed if new)
                tags.append(tag._replace(anchors=kept))
            return replace(frame, tags=tuple(tags))
        case TagFrame0():
            return replace(frame, dis=_distances(frame.dis, change))
        case AnchorFrame0():
            blocks = tuple(tag._replace(dis=_distances(tag.dis, change)) for tag in frame.nodes)
            return replace(frame, nodes=blocks)
    return frame


def _node(node: NodeRange | AoaNodeRange, change: Change) -> NodeRange | AoaNodeRange | None:
    if node.role == Role.TAG:
        return node
    new = change(node.id, node.dis)
    if new is None:
        return None
    return node._replace(
        dis=_least(new.dis),
        rx_rssi=max(node.rx_rssi - new.rx_loss, LEAST_POWER),
        fp_rssi=max(node.fp_rssi - new.fp_loss, LEAST_POWER),
    )


def _distances(distances: AnchorDistances, change: Change) -> AnchorDistances:
    """Distances to anchors 0 to 7; one that fails becomes 0, "none yet"."""
    changed = [change(i, dis) if dis > 0 else None for i, dis in enumerate(distances)]
    return cast("AnchorDistances", tuple(_least(new.dis) if new else 0.0 for new in changed))


def _least(distance: float) -> float:
    return max(distance, LEAST_RANGE)
