"""Anchors whose ranges contradict those of the others: moved or surveyed wrongly; left out for a while."""

import numpy as np


class AnchorTrust:
    """Leaves out an anchor whose ranges err otherwise than those of the others on average.

    A filter draws the pose towards an anchor that stands elsewhere than the site file says, and its residuals
    fade. But odometry holds the pose for a while, so they do not fade at once, and the mean of some tens of
    them is known far better than a single one. Without odometry nothing holds the pose, and every anchor is
    believed. What all anchors err by alike is a bias of the tag, and no anchor's fault.

    A pose that was wrong from the start contradicts anchors, too. So none is left out before all have agreed
    with it for a while.

    With n anchors at most (n - 2) / 2 are left out: more cannot be told from a wrong pose. Ranges of an
    anchor that is left out show whether the pose, which owes them nothing, agrees with it again.

    Here is what is remembered, and `kernels.anchor_trust.note` takes the ranges.

    Args:
        anchors: how many the site has.

    Attributes:
        state: residuals and instants of each anchor, and what they have in common, as `note` wants them.

    Source: Diesel and Luu, "GPS/IRS AIME: Calculation of thresholds and protection radius using chi-square
    methods", ION GPS 1995, for averaged innovations that inertial memory keeps honest.
    """

    def __init__(self, anchors: int) -> None:
        # Numba loads slowly: only who judges ranges waits for it.
        from estimators.kernels import anchor_trust

        self._kernels = anchor_trust
        self.state = (
            np.zeros((anchors, 4)),
            np.zeros((anchors, 3), dtype=np.int64),
            np.zeros(3, dtype=np.int64),
        )
        self.reset()

    def reset(self) -> None:
        """Believe every anchor."""
        self._kernels.believe_all(*self.state)

    def doubt(self, stamp_ns: int) -> float:
        """How far the pose may be off because an anchor contradicts it [m]."""
        return self._kernels.doubt(*self.state[:2], stamp_ns)

    def note_odometry(self, stamp_ns: int) -> None:
        """Odometry came."""
        self.state[2][self._kernels.ODOMETRY_NS] = stamp_ns
