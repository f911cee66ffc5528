"""How likely a unit is after the units before it: counted n-grams with back-off.

Sources: Katz 1987, "Estimation of probabilities from sparse data" (back-off); Mohri, Pereira and
Riley 2002, "Weighted finite-state transducers in speech recognition" (n-grams as a graph).

======== ============================================================== ========
symbol   meaning                                                        shape
======== ============================================================== ========
h        a context: the last units said, as many as are worth knowing   contexts
h'       h without its first unit, or as much of that as is a context   contexts
p(u|h)   share of the unit u after h, if counted                        nodes
b(h)     weight of h' for units not counted after h                     contexts
======== ============================================================== ========

    log p(u | h) = log b(h) + log p(u | h')    for a unit not counted after h

They are kept as a tree whose root is the empty context: a node stands for a unit after the units
on the way to it. The search walks a graph whose states are contexts: the nodes with children, and
those of a single unit. A pause (``sil``) is the first unit of its context: what was said before
it is forgotten.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from shared.phones import UNITS

NUM_UNITS = len(UNITS)
MOST_UNITS = 16  # of an n-gram


@dataclass(frozen=True, slots=True, kw_only=True)
class Graph:
    """The contexts and what leads from one to the next, for the search; context 0 is empty."""

    first_arc: NDArray[np.int32]  # (contexts + 1,) context c has arcs first_arc[c] to [c + 1]
    arc_unit: NDArray[np.uint8]  # (arcs,) ascending in each context
    arc_log_share: NDArray[np.float32]  # (arcs,)
    arc_context: NDArray[np.int32]  # (arcs,) that the unit leads to
    shorter: NDArray[np.int32]  # (contexts,) h'
    log_back_off: NDArray[np.float32]  # (contexts,)
    last_unit: NDArray[np.uint8]  # (contexts,) of context 0 it means nothing


@dataclass(frozen=True, kw_only=True)
class UnitLanguage:
    """The tree: first the root, then its children, then theirs, in the order of the units."""

    num_children: NDArray[np.uint8]  # (nodes,)
    unit: NDArray[np.uint8]  # (nodes,)
    log_share: NDArray[np.float32]  # (nodes,)
    log_back_off: NDArray[np.float32]  # (nodes,)

    @cached_property
    def levels(self) -> list[int]:
        """First node of each level (the root is level 0), and the number of nodes."""
        children = self.num_children.astype(np.int64)
        levels = [0, 1]
        while levels[-1] < len(children):
            levels.append(levels[-1] + int(children[levels[-2] : levels[-1]].sum()))
        return levels

    @cached_property
    def graph(self) -> Graph:
        """The same for the search."""
        children = self.num_children.astype(np.int64)
        num_nodes = len(children)
        levels = self.levels
        parent = np.concatenate([[-1], np.repeat(np.arange(num_nodes), children)])
        key = parent * NUM_UNITS + self.unit  # ascending
        shorter = np.zeros(num_nodes, np.int64)
        for first, end in pairwise(levels[2:]):
            at, unit = shorter[parent[first:end]], self.unit[first:end]
            left = np.arange(first, end)
            while len(left):
                found = np.minimum(np.searchsorted(key, at * NUM_UNITS + unit), num_nodes - 1)
                hit = key[found] == at * NUM_UNITS + unit
                shorter[left[hit]] = found[hit]
                left, at, unit = left[~hit], shorter[at[~hit]], unit[~hit]
        is_context = children > 0
        is_context[: levels[2]] = True
        context = np.cumsum(is_context) - 1
        for first, end in pairwise(levels[2:]):
            level = slice(first, end)
            context[level] = np.where(is_context[level], context[level], context[shorter[level]])
        contexts = np.flatnonzero(is_context)
        ends = np.cumsum(children)[contexts]
        return Graph(
            first_arc=np.concatenate([[0], ends]).astype(np.int32),
            arc_unit=self.unit[1:],
            arc_log_share=self.log_share[1:],
            arc_context=context[1:].astype(np.int32),
            shorter=context[shorter[contexts]].astype(np.int32),
            log_back_off=self.log_back_off[contexts],
            last_unit=self.unit[contexts],
        )
