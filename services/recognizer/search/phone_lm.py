"""Phone language model: back-off n-grams of phones.

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

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Floats, Mask, UInt8
from kouxing.shared.phones.inventory import PhoneInventory

MAX_ORDER = 16  # phones in an n-gram


class ContextGraph(NamedTuple):
    """The contexts and the arcs between them, for the search. Context 0 is the empty one."""

    first_arc: NDArray[np.int32]  # (contexts + 1,) context c has arcs first_arc[c] to [c + 1]
    arc_phone: UInt8  # (arcs,) ascending in each context
    arc_log_prob: Floats  # (arcs,)
    arc_context: NDArray[np.int32]  # (arcs,) context after the arc's phone
    backoff_state: NDArray[np.int32]  # (contexts,) h'
    log_backoff: Floats  # (contexts,)
    last_phone: UInt8  # (contexts,) undefined for context 0


@dataclass(frozen=True, kw_only=True)
class PhoneLanguageModel:
    """The tree in breadth-first order: the root, its children, their children. Siblings ascend."""

    inventory: PhoneInventory
    num_children: UInt8  # (nodes,)
    phone: UInt8  # (nodes,) index into the inventory's phones
    log_prob: Floats  # (nodes,)
    log_backoff: Floats  # (nodes,)

    @cached_property
    def levels(self) -> list[int]:
        """First node of each level (the root is level 0), then the number of nodes."""
        children = self.num_children.astype(np.int64)
        levels = [0, 1]
        while levels[-1] < len(children):
            levels.append(levels[-1] + int(children[levels[-2] : levels[-1]].sum()))
        return levels

    @cached_property
    def graph(self) -> ContextGraph:
        """The tree as a graph of contexts."""
        context, is_context, backoff_state = _find_contexts(self.num_children, self.phone)
        contexts = np.flatnonzero(is_context)
        end = np.cumsum(self.num_children, dtype=np.int32)
        return ContextGraph(
            first_arc=np.append(np.int32(0), end[contexts]),
            arc_phone=self.phone[1:],
            arc_log_prob=self.log_prob[1:],
            arc_context=context[1:],
            backoff_state=context[backoff_state[contexts]],
            log_backoff=self.log_backoff[contexts],
            last_phone=self.phone[contexts],
        )


@numba.njit(cache=True)
def _find_contexts(
    num_children: UInt8, phone: UInt8
) -> tuple[NDArray[np.int32], Mask, NDArray[np.int32]]:
    """Return each node's context, whether the node is a context, and its back-off context's node.

    A node that is not a context leads to its back-off context.
    """
    num_nodes, num_phones = len(num_children), num_children[0]
    first_child = np.empty(num_nodes + 1, np.int32)
    first_child[0] = 1
    for node in range(num_nodes):
        first_child[node + 1] = first_child[node] + num_children[node]
    context = np.zeros(num_nodes, np.int32)
    is_context = np.empty(num_nodes, np.bool_)
    backoff_state = np.zeros(num_nodes, np.int32)
    num_contexts = 0
    for node in range(num_nodes):
        is_context[node] = num_children[node] > 0 or node <= num_phones
        if is_context[node]:
            context[node] = num_contexts
            num_contexts += 1
        else:
            context[node] = context[backoff_state[node]]
        for child in range(first_child[node], first_child[node + 1] if node else 0):
            shorter = backoff_state[node]
            while True:
                match = first_child[shorter]
                while match < first_child[shorter + 1] and phone[match] < phone[child]:
                    match += 1
                if match < first_child[shorter + 1] and phone[match] == phone[child]:
                    backoff_state[child] = match
                    break
                shorter = backoff_state[shorter]
    return context, is_context, backoff_state
