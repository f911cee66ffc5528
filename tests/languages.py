"""Languages of units for tests: tables of n-grams, what the formula makes of them, their trees."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.recognizer.unit_language import NUM_UNITS, Graph, UnitLanguage
from shared.phones import UNIT_INDEX

SIL = UNIT_INDEX["sil"]
START = 1 + SIL  # the context after a pause, among the graph's

Gram = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """Log shares of n-grams, and log back-offs of those that others begin with."""

    log_share: dict[Gram, float]
    log_back_off: dict[Gram, float]

    @classmethod
    def draw(
        cls, rng: np.random.Generator, units: Sequence[int], *, order: int, kept: float = 1.0
    ) -> Table:
        """Draw numbers for all single units, and for a part of the longer n-grams of some."""
        grams: list[Gram] = [(unit,) for unit in range(NUM_UNITS)]
        level: list[Gram] = [(unit,) for unit in units]
        for _ in range(order - 1):
            level = [
                (*gram, unit)
                for gram, unit in itertools.product(level, units)
                if (len(gram) == 1 or gram[-1] != SIL) and rng.random() < kept
            ]
            grams += level
        contexts = {gram[:-1] for gram in grams} | set(grams[:NUM_UNITS])
        return cls(
            {gram: -float(rng.exponential(2.0)) for gram in grams},
            {gram: float(rng.normal(-1.0, 1.0)) for gram in contexts},
        )

    @classmethod
    def of(cls, language: UnitLanguage) -> Table:
        """Read a tree."""
        grams: list[Gram] = [()]
        for node, num_children in enumerate(language.num_children.tolist()):
            first = len(grams)
            units = language.unit[first : first + num_children].tolist()
            grams += [(*grams[node], unit) for unit in units]
        return cls(
            dict(zip(grams[1:], language.log_share[1:].tolist(), strict=True)),
            {
                gram: float(language.log_back_off[node])
                for node, gram in enumerate(grams)
                if language.num_children[node] or len(gram) == 1
            },
        )

    @property
    def order(self) -> int:
        """Units in the longest n-gram."""
        return max(map(len, self.log_share))

    def after(self, said: Gram, unit: int) -> float:
        """Log share of a unit after all that was said: the formula itself."""
        if SIL in said:
            said = said[len(said) - 1 - said[::-1].index(SIL) :]
        return self._after(said[max(0, len(said) - self.order + 1) :], unit)

    def _after(self, context: Gram, unit: int) -> float:
        if (*context, unit) in self.log_share:
            return self.log_share[*context, unit]
        return self.log_back_off.get(context, 0.0) + self._after(context[1:], unit)

    def tree(self) -> UnitLanguage:
        """Lay the table out as a tree."""
        grams: list[Gram] = [(), *sorted(self.log_share, key=lambda gram: (len(gram), gram))]
        num_children = Counter(gram[:-1] for gram in grams[1:])
        return UnitLanguage(
            num_children=np.array([num_children[gram] for gram in grams], np.uint8),
            unit=np.array([gram[-1] if gram else 0 for gram in grams], np.uint8),
            log_share=np.array([self.log_share.get(gram, 0) for gram in grams], np.float32),
            log_back_off=np.array([self.log_back_off.get(gram, 0) for gram in grams], np.float32),
        )


def flat_language() -> UnitLanguage:
    """Make every unit as likely as any other, whatever was said."""
    shares: dict[Gram, float] = {(unit,): -float(np.log(NUM_UNITS)) for unit in range(NUM_UNITS)}
    return Table(shares, {}).tree()


def random_language(rng: np.random.Generator) -> UnitLanguage:
    """Draw a small language."""
    return Table.draw(rng, [0, 21, 30, SIL], order=3).tree()


def step(graph: Graph, context: int, unit: int) -> tuple[float, int]:
    """Log share of a unit after a context, and the context it leads to, as the graph has them."""
    total = 0.0
    while True:
        arcs = slice(graph.first_arc[context], graph.first_arc[context + 1])
        units: NDArray[np.uint8] = graph.arc_unit[arcs]
        at = int(np.searchsorted(units, unit))
        if at < len(units) and units[at] == unit:
            arc = int(graph.first_arc[context]) + at
            return total + float(graph.arc_log_share[arc]), int(graph.arc_context[arc])
        total += float(graph.log_back_off[context])
        context = int(graph.shorter[context])
