"""A graph over the last seconds: what is older is kept as what it says of the rest (fixed-lag smoothing).

A node is the state at one instant: a pose and the velocity after it, or a pose alone. Nodes are in the order
of time, behind the variables that do not move. Those older than the lag are marginalised: the factors on them
are linearised for good and become a quadratic on the nodes that they share factors with. Time and memory of
an update are bounded by the nodes within the lag.

Source: Dong-Si and Mourikis, ICRA 2011, fixed-lag smoothing by marginalisation.
"""

from collections.abc import Collection

import numpy as np

from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.factors import DensePrior, Graph
from estimators.graph.solver import arrays
from estimators.kernels import optimise, window
from estimators.kernels.factors import last_use, system_of
from estimators.kernels.window import BoolArray
from estimators.messages import FloatArray, IntArray

_TABLES = {"increments": 2, "ranges": 2, "sightings": 2, "motions": 4, "priors": 1}
"""Leading columns of each table that are variables."""


class FixedLag:
    """Sliding window of nodes.

    Attributes:
        graph: of the window; values are those of the last `update`.
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
        self._iterations = iterations
        self._tolerance = tolerance
        self.graph = Graph(known.copy(), np.zeros_like(known))
        self.stamps_ns = np.empty(0, dtype=np.int64)

    def variable(self, node: int) -> int:
        """Number of a node's pose; its velocity has the next."""
        return self._known + self._width * node

    def node_at(self, stamp_ns: int) -> int | None:
        """The node of an instant, if the window has it."""
        node = int(np.searchsorted(self.stamps_ns, stamp_ns))
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
        node = int(np.searchsorted(self.stamps_ns, stamp_ns))
        graph, at = self.graph, self.variable(node)
        if node < len(self.stamps_ns):
            self._renumber(np.arange(len(graph.values)) + self._width * (np.arange(len(graph.values)) >= at))
            graph.values = np.insert(graph.values, at, state, axis=0)
            self.stamps_ns = np.insert(self.stamps_ns, node, stamp_ns)
        else:
            graph.values = np.concatenate([graph.values, state])
            self.stamps_ns = np.append(self.stamps_ns, stamp_ns)
        graph.free = np.concatenate([graph.free, np.full((self._width, 3), 1.0)])
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
            setattr(self.graph, name, np.concatenate([getattr(self.graph, name), rows]))

    def drop_before(self, horizon_ns: int, kept_ns: Collection[int] = ()) -> None:
        """Marginalise what is older than the horizon.

        Nodes at which increments to younger nodes begin stay, and so does the newest.

        Args:
            horizon_ns: older nodes go.
            kept_ns: instants of nodes that stay all the same.
        """
        if len(self.stamps_ns) < 2 or self.stamps_ns[0] >= horizon_ns:
            return
        leaving = window.leaving(self.stamps_ns, horizon_ns, self.graph.increments, self._known, self._width)
        leaving[-1] = False
        for stamp_ns in kept_ns:
            if (node := self.node_at(stamp_ns)) is not None:
                leaving[node] = False
        if leaving.any():
            self._marginalise(leaving)

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
        values, covariance = self._optimum(asked, self._iterations)
        self.graph.values = values
        return covariance

    def state_of(self, node: int) -> tuple[FloatArray, FloatArray]:
        """State (3 width,) of any node and its covariance, given all that is in the window.

        Raises:
            GraphError: as `update`.
        """
        asked = [self.variable(node) + i for i in range(self._width)]
        return self.graph.values[asked].ravel(), self._optimum(asked, 1)[1]

    def _optimum(self, asked: list[int], iterations: int) -> tuple[FloatArray, FloatArray]:
        """Values (V, 3) at the optimum, and the covariance of the variables asked for."""
        graph = self.graph
        taken = arrays(graph)
        count = len(graph.values)
        last_needed = last_use(taken)
        # What is asked for goes last: its covariance is then read off the end of the factor.
        last_needed[asked] = count + np.arange(len(asked))
        order = np.full(count, -1, dtype=np.int64)
        sequence = self._known + np.argsort(last_needed[self._known :], kind="stable")
        order[sequence] = np.arange(len(sequence))
        system = system_of(taken, order, len(sequence))
        values = graph.values.copy()
        status, _, _, diagonal, below = optimise.gauss_newton(
            values, taken, system, iterations, self._tolerance
        )
        if status not in (optimise.CONVERGED, optimise.NOT_CONVERGED) or not np.isfinite(values).all():
            raise GraphError("window: something in it is not determined, or not finite")
        covariance = optimise.last_covariance(system[1], system[2], diagonal, below, len(asked))
        return values, covariance

    def _marginalise(self, leaving: BoolArray, everything: bool = False) -> None:
        """Linearise the factors on nodes that leave, or all factors, and keep what they say of the rest."""
        graph, count = self.graph, len(self.graph.values)
        gone = np.zeros(count, dtype=np.bool_)
        gone[self._known :] = np.repeat(leaving, self._width)
        numbers = np.cumsum(~gone) - 1
        touched = gone.copy()
        touched[graph.dense.variables] = True
        part = Graph(graph.values, graph.free, dense=graph.dense)
        for name, columns in _TABLES.items():
            table = getattr(graph, name)
            if len(table):
                goes = np.ones(count, dtype=np.bool_) if everything else gone
                taken, rest = window.divide(table, columns, goes, touched, numbers)
                setattr(part, name, taken)
                setattr(graph, name, rest)
        touched[: self._known] = False
        staying, eliminated = np.flatnonzero(touched & ~gone), int(gone.sum())
        order = np.full(count, -1, dtype=np.int64)
        order[gone] = np.arange(eliminated)
        order[staying] = eliminated + np.arange(len(staying))
        system = system_of(arrays(part), order, eliminated + len(staying))
        _, information, gradient = optimise.marginalise(graph.values, arrays(part), system, eliminated)
        graph.dense = DensePrior(numbers[staying], graph.values[staying], information, gradient)
        graph.values, graph.free = graph.values[~gone], graph.free[~gone]
        self.stamps_ns = self.stamps_ns[~leaving]

    def _renumber(self, numbers: IntArray) -> None:
        """Give every variable a new number (V,), in tables and prior."""
        graph, dense = self.graph, self.graph.dense
        for name, columns in _TABLES.items():
            table = getattr(graph, name)
            table[:, :columns] = numbers[table[:, :columns].astype(np.int64)]
        graph.dense = DensePrior(numbers[dense.variables], dense.at, dense.information, dense.gradient)
