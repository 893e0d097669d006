"""What can be wrong with a graph."""


class GraphError(ValueError):
    """A graph that has no solution, or more than one; the message names the variable."""
