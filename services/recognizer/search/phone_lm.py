"""Phone language model: the probability of a phone given the phones before it. Back-off n-grams.

Sources: Katz 1987, "Estimation of probabilities from sparse data" (back-off); Mohri, Pereira and
Riley 2002, "Weighted finite-state transducers in speech recognition" (n-grams as a graph).

======== ============================================================== ========
symbol   meaning                                                        shape
======== ============================================================== ========
h        context: the previous phones, as many as the model keeps       contexts
h'       back-off context: the longest known ending of h                contexts
p(u|h)   probability of phone u after h, if the n-gram is kept          nodes
b(h)     back-off weight of h'                                          contexts
======== ============================================================== ========

    log p(u | h) = log b(h) + log p(u | h')    if the n-gram h u is not kept

The n-grams are stored as a tree. The root is the empty context, and a node is the last phone of an
n-gram whose other phones are the node's ancestors. The search uses a graph whose states are
contexts: the nodes with children, and all single phones. A pause resets the context: an n-gram has
silence only as its first or last phone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.phones.inventory import PhoneInventory

MAX_ORDER = 16  # phones in an n-gram


class Graph(NamedTuple):
    """The contexts and the arcs between them, for the search. Context 0 is the empty one."""

    first_arc: NDArray[np.int32]  # (contexts + 1,) context c has arcs first_arc[c] to [c + 1]
    arc_phone: NDArray[np.uint8]  # (arcs,) ascending in each context
    arc_log_prob: NDArray[np.float32]  # (arcs,)
    arc_context: NDArray[np.int32]  # (arcs,) context after the arc's phone
    backoff_state: NDArray[np.int32]  # (contexts,) h'
    log_backoff: NDArray[np.float32]  # (contexts,)
    last_phone: NDArray[np.uint8]  # (contexts,) undefined for context 0


@dataclass(frozen=True, kw_only=True)
class PhoneLanguageModel:
    """The tree in breadth-first order: the root, its children, their children. Siblings ascend."""

    inventory: PhoneInventory
    num_children: NDArray[np.uint8]  # (nodes,)
    phone: NDArray[np.uint8]  # (nodes,) index into the inventory's phones
    log_prob: NDArray[np.float32]  # (nodes,)
    log_backoff: NDArray[np.float32]  # (nodes,)

    @cached_property
    def levels(self) -> list[int]:
        """First node of each level (the root is level 0), then the number of nodes."""
        children = self.num_children.astype(np.int64)
        levels = [0, 1]
        while levels[-1] < len(children):
            levels.append(levels[-1] + int(children[levels[-2] : levels[-1]].sum()))
        return levels

    @cached_property
    def graph(self) -> Graph:
        """The tree as a graph of contexts."""
        num_phones = len(self.inventory)
        children = self.num_children.astype(np.int64)
        num_nodes = len(children)
        levels = self.levels
        parent = np.concatenate([[-1], np.repeat(np.arange(num_nodes), children)])
        key = parent * num_phones + self.phone  # ascending
        backoff_state = np.zeros(num_nodes, np.int64)
        for first, end in pairwise(levels[2:]):
            at, phone = backoff_state[parent[first:end]], self.phone[first:end]
            left = np.arange(first, end)
            while len(left):
                node = np.minimum(np.searchsorted(key, at * num_phones + phone), num_nodes - 1)
                hit = key[node] == at * num_phones + phone
                backoff_state[left[hit]] = node[hit]
                left, at, phone = left[~hit], backoff_state[at[~hit]], phone[~hit]
        is_context = children > 0
        is_context[: levels[2]] = True
        context = np.cumsum(is_context) - 1
        for first, end in pairwise(levels[2:]):
            level = slice(first, end)
            context[level] = np.where(
                is_context[level], context[level], context[backoff_state[level]]
            )
        contexts = np.flatnonzero(is_context)
        ends = np.cumsum(children)[contexts]
        return Graph(
            first_arc=np.concatenate([[0], ends]).astype(np.int32),
            arc_phone=self.phone[1:],
            arc_log_prob=self.log_prob[1:],
            arc_context=context[1:].astype(np.int32),
            backoff_state=context[backoff_state[contexts]].astype(np.int32),
            log_backoff=self.log_backoff[contexts],
            last_phone=self.phone[contexts],
        )
