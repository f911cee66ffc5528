"""Languages for tests: an installed one, phone language models and random HMMs."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import NUM_PHRASE_POSITIONS, Topology
from kouxing.services.recognizer.search.phone_lm import ContextGraph, PhoneLanguageModel
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript
from kouxing.shared.plugins import plugins

MANDARIN = load_inventory("mandarin")
NUM_PHONES = len(MANDARIN)
SIL = MANDARIN.index[MANDARIN.silence]
START = 1 + SIL  # the context after a pause, among the graph's

NGram = tuple[int, ...]


@contextmanager
def installed_language(folder: Path, name: str, package: str) -> Iterator[None]:
    """Install a distribution with a language into a folder that Python searches."""
    distribution = folder / f"kouxing_{name}-1.0.dist-info"
    distribution.mkdir()
    (distribution / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: kouxing-{name}\nVersion: 1.0\n"
    )
    (distribution / "entry_points.txt").write_text(f"[kouxing.languages]\n{name} = {package}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        plugins.cache_clear()
        yield
    plugins.cache_clear()


def small_inventory(**changes: object) -> PhoneInventory:
    """Return an inventory of three phones, with changes to its fields."""
    values = {
        "language": "small",
        "phones": ("m", "a", "sil"),
        "kinds": ("initial", "vowel", "silence"),
        "visemes": {"m": (("b", 1.0),), "a": (("a", 0.5), ("e", 0.5)), "sil": (("rest", 1.0),)},
        "before_rounded": {},
        "read": lambda text: Transcript((SpokenSyllable(text, text, tuple(text)),)),
    }
    return PhoneInventory(**(values | changes))  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Table:
    """Log-probabilities of n-grams, and log back-off weights of contexts."""

    log_prob: dict[NGram, float]
    log_backoff: dict[NGram, float]

    @classmethod
    def draw(
        cls, rng: np.random.Generator, phones: Sequence[int], *, order: int, kept: float = 1.0
    ) -> Table:
        """Draw values for all single phones, and for some longer n-grams of ``phones``."""
        grams: list[NGram] = [(phone,) for phone in range(NUM_PHONES)]
        level: list[NGram] = [(phone,) for phone in phones]
        for _ in range(order - 1):
            level = [
                (*gram, phone)
                for gram, phone in itertools.product(level, phones)
                if (len(gram) == 1 or gram[-1] != SIL) and rng.random() < kept
            ]
            grams += level
        contexts = {gram[:-1] for gram in grams} | set(grams[:NUM_PHONES])
        return cls(
            {gram: -float(rng.exponential(2.0)) for gram in grams},
            {gram: float(rng.normal(-1.0, 1.0)) for gram in contexts},
        )

    @classmethod
    def of(cls, language: PhoneLanguageModel) -> Table:
        """Read a tree."""
        grams: list[NGram] = [()]
        for node, num_children in enumerate(language.num_children.tolist()):
            first = len(grams)
            phones = language.phone[first : first + num_children].tolist()
            grams += [(*grams[node], phone) for phone in phones]
        return cls(
            dict(zip(grams[1:], language.log_prob[1:].tolist(), strict=True)),
            {
                gram: float(language.log_backoff[node])
                for node, gram in enumerate(grams)
                if language.num_children[node] or len(gram) == 1
            },
        )

    @property
    def order(self) -> int:
        """Phones in the longest n-gram."""
        return max(map(len, self.log_prob))

    def after(self, before: NGram, phone: int) -> float:
        """Return the log-probability of a phone after all phones before it, by the formula."""
        if SIL in before:
            before = before[len(before) - 1 - before[::-1].index(SIL) :]
        return self._after(before[max(0, len(before) - self.order + 1) :], phone)

    def _after(self, context: NGram, phone: int) -> float:
        if (*context, phone) in self.log_prob:
            return self.log_prob[*context, phone]
        return self.log_backoff.get(context, 0.0) + self._after(context[1:], phone)

    def tree(self, inventory: PhoneInventory = MANDARIN) -> PhoneLanguageModel:
        """Convert the table to a tree."""
        grams: list[NGram] = [(), *sorted(self.log_prob, key=lambda gram: (len(gram), gram))]
        num_children = Counter(gram[:-1] for gram in grams[1:])
        return PhoneLanguageModel(
            inventory=inventory,
            num_children=np.array([num_children[gram] for gram in grams], np.uint8),
            phone=np.array([gram[-1] if gram else 0 for gram in grams], np.uint8),
            log_prob=np.array([self.log_prob.get(gram, 0) for gram in grams], np.float32),
            log_backoff=np.array([self.log_backoff.get(gram, 0) for gram in grams], np.float32),
        )


def flat_language(inventory: PhoneInventory = MANDARIN) -> PhoneLanguageModel:
    """Make all phones equally likely in every context."""
    num_phones = len(inventory)
    log_probs: dict[NGram, float] = {(phone,): -math.log(num_phones) for phone in range(num_phones)}
    return Table(log_probs, {}).tree(inventory)


def random_topology(
    states_per_phone: int, rng: np.random.Generator, language: PhoneLanguageModel | None = None
) -> Topology:
    """Draw HMMs; without a language, all phones are equally likely."""
    stay = rng.uniform(0.2, 0.8, NUM_PHONES * states_per_phone)
    duration_s = np.full((NUM_PHRASE_POSITIONS, NUM_PHONES), 0.1, np.float32)
    return Topology(
        first_state=np.arange(NUM_PHONES + 1) * states_per_phone,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        phone_lm=language or flat_language(),
        duration_mean_s=duration_s,
        duration_spread_s=duration_s,
    )


def step(graph: ContextGraph, context: int, phone: int) -> tuple[float, int]:
    """Return a phone's log-probability after a context, and the next context, by the graph."""
    total = 0.0
    while True:
        arcs = slice(graph.first_arc[context], graph.first_arc[context + 1])
        phones: NDArray[np.uint8] = graph.arc_phone[arcs]
        at = int(np.searchsorted(phones, phone))
        if at < len(phones) and phones[at] == phone:
            arc = int(graph.first_arc[context]) + at
            return total + float(graph.arc_log_prob[arc]), int(graph.arc_context[arc])
        total += float(graph.log_backoff[context])
        context = int(graph.backoff_state[context])
