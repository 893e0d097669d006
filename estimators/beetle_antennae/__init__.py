"""Beetle antennae searches: the point of least cost of a function of which only values can be asked.

BAS is one beetle that compares the cost at its two antennae and steps to the better side; IBAS is a swarm of
them. huang2024 writes both for a fitness to be maximised. Here a cost is minimised everywhere, so its
``sign(f(X_R) - f(X_L))`` becomes ``sign(cost_L - cost_R)``. Each search exists with the equations as they
are printed and with corrections; `companion evaluate functions` measures them all.
"""

from estimators.beetle_antennae.bas import BeetleAntennaeSearch, PrintedBeetleAntennaeSearch
from estimators.beetle_antennae.base import BeetleSearch, Bounds, Found, Objective
from estimators.beetle_antennae.ibas import (
    ImprovedBeetleAntennaeSearch,
    PrintedImprovedBeetleAntennaeSearch,
    ProseImprovedBeetleAntennaeSearch,
)

__all__ = [
    "SEARCHES",
    "BeetleAntennaeSearch",
    "BeetleSearch",
    "Bounds",
    "Found",
    "ImprovedBeetleAntennaeSearch",
    "Objective",
    "PrintedBeetleAntennaeSearch",
    "PrintedImprovedBeetleAntennaeSearch",
    "ProseImprovedBeetleAntennaeSearch",
]

SEARCHES: dict[str, type[BeetleSearch]] = {
    "bas_printed": PrintedBeetleAntennaeSearch,
    "bas": BeetleAntennaeSearch,
    "ibas_printed": PrintedImprovedBeetleAntennaeSearch,
    "ibas_prose": ProseImprovedBeetleAntennaeSearch,
    "ibas": ImprovedBeetleAntennaeSearch,
}
"""Name -> class; made without arguments, a search has the paper's settings."""
