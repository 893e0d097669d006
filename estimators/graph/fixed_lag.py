"""A graph over the last seconds: what is older is kept as what it says of the rest (fixed-lag smoothing).

A node is the state at one instant: a pose and the velocity after it, or a pose alone. Nodes are in the order
of time, behind the variables that do not move. Those older than the lag are marginalised: the factors on them
are linearised for good and become a quadratic on the nodes that they share factors with. Time and memory of
an update are bounded by the nodes within the lag.

Most updates do not solve for all of the window. What it said of its newest state, and of the pose that
increments refer to, when it was last solved as a whole is a quadratic, too; nodes that came since are solved
with that. All is solved and linearised anew after `_MOST_NEW` nodes, and at once when that quadratic is no
longer good: what it is on has moved too far, or a factor goes further back.

Source: Dong-Si and Mourikis, ICRA 2011, fixed-lag smoothing by marginalisation; linearising anew only what
moved: Kaess et al., iSAM2, International Journal of Robotics Research 31(2), 2012.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.factors import DensePrior, Graph
from estimators.graph.solver import arrays
from estimators.immutable import immutable
from estimators.kernels import optimise, window
from estimators.kernels.window import BoolArray
from estimators.messages import FloatArray, IntArray

_TABLES = {"increments": 2, "ranges": 2, "sightings": 2, "motions": 4, "priors": 1}
"""Leading columns of each table that are variables."""
_MOST_NEW = 10
"""Nodes that are solved for without the others: with more, a solution of all costs little in comparison."""
_FARTHEST = 3.0
"""So many times what the search tolerates may that move which old nodes say something of, until they are
linearised anew. By default that is 3 cm and 0.03 rad; iSAM2 as GTSAM ships it waits for 0.1 of either."""


@immutable
class _Settled:
    """A window when all of it was solved.

    Attributes:
        nodes: how many it had.
        rows: how many factors, by the name of their table.
        said: what all of them said of its newest state, and of a reference.
    """

    nodes: int
    rows: dict[str, int]
    said: DensePrior


class FixedLag:
    """Sliding window of nodes.

    Attributes:
        graph: of the window; values are those of the last `update`, older ones of one before.
        stamps_ns: (N,) instants of the nodes.

    Args:
        known: (A, 3) variables that are known: anchors and landmarks; their numbers come first.
        width: variables of a node: 2 with velocities, 1 without.
        iterations: Gauss-Newton steps of an update, at most.
        tolerance: it ends when no value moved by more [m, rad].
    """

    def __init__(self, known: FloatArray, width: int, iterations: int = 4, tolerance: float = 1e-2) -> None:
        self._known = len(known)
        self._width = width
        self._all_free = np.ones((width, 3))
        self._iterations = iterations
        self._tolerance = tolerance
        self.graph = Graph(known.copy(), np.zeros_like(known))
        self.stamps_ns = np.empty(0, dtype=np.int64)
        self._room: dict[str, FloatArray | IntArray] = {}
        self._settled: _Settled | None = None

    def variable(self, node: int) -> int:
        """Number of a node's pose; its velocity has the next."""
        return self._known + self._width * node

    def node_at(self, stamp_ns: int) -> int | None:
        """The node of an instant, if the window has it."""
        node = int(self.stamps_ns.searchsorted(stamp_ns))
        return node if node < len(self.stamps_ns) and self.stamps_ns[node] == stamp_ns else None

    def nearest(self, stamp_ns: int) -> int:
        """The node nearest to an instant."""
        later = int(np.searchsorted(self.stamps_ns, stamp_ns))
        around = [node for node in (later - 1, later) if 0 <= node < len(self.stamps_ns)]
        return min(around, key=lambda node: abs(int(self.stamps_ns[node]) - stamp_ns))

    def begin(self, stamp_ns: int, state: FloatArray, cov: FloatArray) -> None:
        """Put the first node.

        Args:
            stamp_ns: its instant.
            state: (width, 3) expected.
            cov: (3 width, 3 width) covariance of the same.
        """
        self.insert(stamp_ns, state)
        variables = self.variable(0) + np.arange(self._width)
        information = np.asarray(np.linalg.inv(cov), dtype=np.float64)
        self.graph.dense = DensePrior(variables, state, information, np.zeros(3 * self._width))

    @property
    def newest(self) -> FloatArray:
        """State (width, 3) of the newest node."""
        return self.graph.values[-self._width :]

    def insert(self, stamp_ns: int, state: FloatArray) -> int:
        """Put a node where it belongs in time; there is none yet of that instant.

        Args:
            stamp_ns: its instant.
            state: (width, 3) thought of it.

        Returns:
            Its number; numbers of later nodes grow by one.
        """
        node = int(self.stamps_ns.searchsorted(stamp_ns))
        graph, at = self.graph, self.variable(node)
        if node < len(self.stamps_ns):
            self._settled = None
            self._renumber(np.arange(len(graph.values)) + self._width * (np.arange(len(graph.values)) >= at))
            graph.values = np.insert(graph.values, at, state, axis=0)
            self.stamps_ns = np.insert(self.stamps_ns, node, stamp_ns)
        else:
            self._append(graph, "values", state)
            self._append(self, "stamps_ns", [stamp_ns])
        self._append(graph, "free", self._all_free)
        return node

    def interpolate(self, stamp_ns: int) -> int | None:
        """Put a node between two that a motion connects, and divide the motion; None where there is none."""
        later = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if not 0 < later < len(self.stamps_ns):
            return None
        ends, motions = [self.variable(later - 1), self.variable(later)], self.graph.motions
        spanning = np.flatnonzero((motions[:, [0, 2]] == ends).all(axis=1))
        if len(spanning) == 0:
            return None
        (k,) = spanning
        noise, whole = motions[k, 5:], motions[k, 4]
        before = (stamp_ns - self.stamps_ns[later - 1]) * 1e-9
        earlier_state, later_state = (self.graph.values[end : end + self._width] for end in ends)
        state = earlier_state + before / whole * (later_state - earlier_state)
        self.graph.motions = np.delete(motions, k, axis=0)
        node = self.insert(stamp_ns, state)
        at = [self.variable(node + i) for i in (-1, 0, 1)]
        self.add(motions=factors.motions(at[:2], at[1:], [before, whole - before], *noise))
        return node

    def add(self, **tables: FloatArray) -> None:
        """Add factors, rows of `estimators.graph.factors` by the name of their table in the graph."""
        for name, rows in tables.items():
            self._append(self.graph, name, rows)

    def drop_before(self, horizon_ns: int, kept_ns: Collection[int] = ()) -> bool:
        """Marginalise what is older than the horizon, once the last update was one of the whole window.

        Nodes at which increments to younger nodes begin stay, and so does the newest.

        Args:
            horizon_ns: older nodes go.
            kept_ns: instants of nodes that stay all the same.

        Returns:
            Whether any node has left.
        """
        if len(self.stamps_ns) < 2 or self.stamps_ns[0] >= horizon_ns or self._has_new():
            return False
        leaving = window.leaving(self.stamps_ns, horizon_ns, self.graph.increments, self._known, self._width)
        leaving[-1] = False
        for stamp_ns in kept_ns:
            if (node := self.node_at(stamp_ns)) is not None:
                leaving[node] = False
        if not leaving.any():
            return False
        self._marginalise(leaving)
        return True

    def absorb(self) -> None:
        """Make all that is known of the nodes a quadratic: their factors will not be linearised again."""
        self._marginalise(np.zeros(len(self.stamps_ns), dtype=np.bool_), everything=True)

    def update(self, reference: int | None = None) -> FloatArray:
        """Bring the window to its optimum.

        Args:
            reference: an earlier node whose pose shall be told along with the newest state.

        Returns:
            Covariance of the newest state, after it of the pose of the reference, if one is asked for.

        Raises:
            GraphError: something in it is not determined, or not finite. The window is then as it was.
        """
        asked = [self.variable(len(self.stamps_ns) - 1) + i for i in range(self._width)]
        if reference is not None:
            asked.append(self.variable(reference))
        variables = np.array(asked)
        covariance = self._solve_newest(variables)
        if covariance is None:
            self.graph.values, covariance, information = self._solve_all(variables, self._iterations)
            at = self.graph.values[variables]
            self._settle(DensePrior(variables, at, information, np.zeros(len(information))))
        return covariance

    def _settle(self, said: DensePrior) -> None:
        """Note what the window says now that all of it was solved."""
        rows = {name: len(getattr(self.graph, name)) for name in _TABLES}
        self._settled = _Settled(len(self.stamps_ns), rows, said)

    def state_of(self, node: int) -> tuple[FloatArray, FloatArray]:
        """State (3 width,) of any node and its covariance, given all that is in the window.

        Raises:
            GraphError: as `update`.
        """
        variables = self.variable(node) + np.arange(self._width)
        values, covariance, _ = self._solve_all(variables, 1)
        return values[variables].ravel(), covariance

    def _has_new(self) -> bool:
        """Whether anything came since all was solved."""
        settled = self._settled
        return settled is not None and (
            len(self.stamps_ns) > settled.nodes
            or any(len(getattr(self.graph, name)) > count for name, count in settled.rows.items())
        )

    def _solve_newest(self, asked: IntArray) -> FloatArray | None:
        """Solve for the nodes that came since all was solved; covariance of the variables asked for.

        None, and all is as it was, where that would not be the optimum of the window.
        """
        settled, graph = self._settled, self.graph
        if settled is None or not self._has_new() or len(self.stamps_ns) - settled.nodes > _MOST_NEW:
            return None
        said, rows = settled.said, settled.rows
        newer = (
            graph.free,
            graph.increments[rows["increments"] :],
            graph.ranges[rows["ranges"] :],
            graph.sightings[rows["sightings"] :],
            graph.motions[rows["motions"] :],
            graph.priors[rows["priors"] :],
            said.variables,
            said.at,
            said.information,
            said.gradient,
        )
        status, covariance = window.solve_newest(
            graph.values,
            newer,
            asked,
            self._known,
            self._width,
            self.variable(settled.nodes),
            self._iterations,
            self._tolerance,
            _FARTHEST * self._tolerance,
        )
        return covariance if status in (optimise.CONVERGED, optimise.NOT_CONVERGED) else None

    def _solve_all(self, asked: IntArray, iterations: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values (V, 3) at the optimum; covariance of the variables asked for, and its inverse."""
        values = self.graph.values.copy()
        status, covariance, root = window.solve_window(
            values, arrays(self.graph), asked, self._known, self._known, iterations, self._tolerance
        )
        if status not in (optimise.CONVERGED, optimise.NOT_CONVERGED):
            raise GraphError("window: something in it is not determined, or not finite")
        return values, covariance, root @ root.T

    def _marginalise(self, leaving: BoolArray, everything: bool = False) -> None:
        """Linearise the factors on nodes that leave, or all factors, and keep what they say of the rest."""
        settled, self._settled = self._settled, None
        values, kept, numbers = window.forget(
            self.graph.values, arrays(self.graph), leaving, self._known, self._width, everything
        )
        self.graph = Graph(values, *kept[:6], DensePrior(*kept[6:]))
        self.stamps_ns = self.stamps_ns[~leaving]
        if settled is not None and not everything:
            said = settled.said
            if not leaving[(said.variables - self._known) // self._width].any():
                self._settle(replace(said, variables=numbers[said.variables]))

    def _append(self, owner: "FixedLag | Graph", name: str, rows: FloatArray | list[int]) -> None:
        """Put rows behind those of an array that window or graph has, into room that was left for them."""
        there, room = getattr(owner, name), self._room.get(name)
        begin, end = len(there), len(there) + len(rows)
        # An array that has been replaced since has no room.
        if room is None or there.base is not room or end > len(room):
            room = self._room[name] = np.empty((2 * end, *there.shape[1:]), dtype=there.dtype)
            room[:begin] = there
        room[begin:end] = rows
        setattr(owner, name, room[:end])

    def _renumber(self, numbers: IntArray) -> None:
        """Give every variable a new number (V,), in tables and prior."""
        graph, dense = self.graph, self.graph.dense
        for name, columns in _TABLES.items():
            table = getattr(graph, name)
            table[:, :columns] = numbers[table[:, :columns].astype(np.int64)]
        graph.dense = DensePrior(numbers[dense.variables], dense.at, dense.information, dense.gradient)
