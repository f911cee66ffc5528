"""The best path of known phones: memory, and the band of long utterances."""

import tracemalloc

import numpy as np
import pytest

from kouxing.services.recognizer.search import forced_path
from kouxing.services.recognizer.search.forced_path import (
    UtteranceGraph,
    build_utterance_graph,
    segments_of_path,
    viterbi_path,
)
from tests.languages import MANDARIN, SIL

FIRST_STATE = np.arange(len(MANDARIN) + 1) * 3
HALF = np.full(len(MANDARIN) * 3, np.log(0.5), np.float32)


def spoken_phones(num_phones: int, num_frames: int) -> tuple[UtteranceGraph, np.ndarray, list[int]]:
    """Return an utterance with pauses, its scores, and its phones with 6 frames each."""
    rng = np.random.default_rng(0)
    phones = rng.choice(np.delete(np.arange(len(MANDARIN)), SIL), num_phones).tolist()
    graph = build_utterance_graph(phones, [1] * num_phones, FIRST_STATE, silence=SIL)
    scores = rng.normal(-9, 1, (num_frames, FIRST_STATE[-1])).astype(np.float32)
    states = np.concatenate([np.repeat(FIRST_STATE[p] + np.arange(3), 2) for p in phones])
    pause = np.repeat(FIRST_STATE[SIL] + np.arange(3), [2, 2, num_frames])
    middle = len(states) // 2
    states = np.concatenate([states[:middle], pause[: num_frames - len(states)], states[middle:]])
    scores[np.arange(num_frames), states] = 0.0
    return graph, scores, phones


def test_a_band_finds_the_same_path_past_a_long_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, scores, _ = spoken_phones(num_phones=600, num_frames=6000)
    path, likelihood = viterbi_path(scores, graph.states, graph, HALF, HALF)
    monkeypatch.setattr(forced_path, "MAX_BAND_NODES", 600)  # of 5400 nodes
    in_band, likelihood_in_band = viterbi_path(scores, graph.states, graph, HALF, HALF)
    np.testing.assert_array_equal(in_band, path)
    assert likelihood_in_band == likelihood


def test_a_band_reaches_the_end_of_a_text_that_is_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, scores, _ = spoken_phones(num_phones=600, num_frames=4000)
    monkeypatch.setattr(forced_path, "MAX_BAND_NODES", 600)
    for num_frames in (1800, 1900, 2500):  # 3 for each phone are needed
        path, _ = viterbi_path(scores[:num_frames], graph.states, graph, HALF, HALF)
        assert len(path) == num_frames
        assert path[-1] >= len(graph.states) - 1 - graph.num_last


def test_the_memory_of_a_path_does_not_grow_with_the_square_of_the_length() -> None:
    graph, scores, phones = spoken_phones(num_phones=1000, num_frames=7000)
    tracemalloc.start()
    path, _ = viterbi_path(scores, graph.states, graph, HALF, HALF)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 0.05 * 4 * len(scores) * len(graph.states)
    segments = segments_of_path(path, graph)
    assert [segment.phone for segment in segments if segment.phone != SIL] == phones
