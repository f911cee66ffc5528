"""Chunks and other sessions do not affect results; invariants of search and output rule."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import Resampler, to_16_khz
from kouxing.services.recognizer.live.live_decoder import LiveDecoder
from kouxing.services.recognizer.live.speech_scorer import FrameScores
from kouxing.services.recognizer.live.speech_segmenter import SpeechEnd, SpeechStart
from kouxing.services.recognizer.search.decoder import Decoder, LastPhone
from kouxing.services.recognizer.search.output_rule import OutputRule, OutputRuleConfig
from kouxing.shared.phones.events import Phone

NOISE = np.random.default_rng(0).normal(0, 0.1, 12_000).astype(np.float32)
CUTS = st.lists(st.integers(0, 32_000), max_size=60)


def pieces(samples: np.ndarray, cuts: list[int]) -> list[np.ndarray]:
    return np.split(samples, sorted(cut for cut in cuts if cut <= len(samples)))


def last_phone_after(decoder: Decoder, row: np.ndarray) -> LastPhone:
    decoder.advance(row[None])
    return decoder.last_phone


@settings(max_examples=30)
@given(cuts=CUTS, rate_hz=st.integers(8_000, 48_000))
def test_chunks_do_not_affect_resampling(cuts: list[int], rate_hz: int) -> None:
    resampler = Resampler(rate_hz)
    parts = [resampler.accept_waveform(piece) for piece in pieces(NOISE, cuts)]
    undivided = to_16_khz(NOISE, rate_hz)
    np.testing.assert_array_equal(np.concatenate([*parts, resampler.finish()]), undivided)


@settings(max_examples=10)
@given(cuts=CUTS, name=st.sampled_from(["gmm", "blocks"]))
def test_chunks_do_not_affect_front_ends(cuts: list[int], name: str) -> None:
    model = load_model(name)
    front_end = model.create_front_end()
    parts = [front_end.accept_waveform(piece) for piece in pieces(NOISE, cuts)]
    undivided = model.create_front_end().accept_waveform(NOISE)
    np.testing.assert_array_equal(np.concatenate(parts), undivided)


@settings(max_examples=50)
@given(phones=st.lists(st.integers(0, 3), max_size=60), num_stable_frames=st.integers(1, 6))
def test_output_rule_matches_the_paper(phones: list[int], num_stable_frames: int) -> None:
    """Compare with Li 2011, eq. 4."""
    last = 9
    rule = OutputRule(OutputRuleConfig(num_stable_frames, 0.0), last_emitted=last)
    for t, phone in enumerate(phones):
        recent = phones[max(0, t - num_stable_frames + 1) : t + 1]
        expected = len(recent) == num_stable_frames and set(recent) == {phone} and phone != last
        assert rule.update(phone, 0.1) == expected
        last = phone if expected else last


def test_frames_with_low_confidence_do_not_count() -> None:
    rule = OutputRule(OutputRuleConfig(2, 0.7), last_emitted=0)
    frames = [(1, 0.9), (1, 0.6), (1, 0.8), (1, 0.7), (2, 0.9), (3, 0.9), (3, 0.9)]
    assert [frame for frame, scored in enumerate(frames) if rule.update(*scored)] == [3, 6]


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31), num_frames=st.integers(2, 300), data=st.data())
def test_a_search_continues_from_the_state_of_another(
    seed: int, num_frames: int, data: st.DataObject
) -> None:
    topology = load_model().topology
    rng = np.random.default_rng(seed)
    rows = rng.normal(0, 5, (num_frames, topology.num_states)).astype(np.float32)
    at = data.draw(st.integers(0, num_frames - 1))
    uninterrupted, before, after = (Decoder(topology) for _ in range(3))
    for row in rows[::-1]:
        last_phone_after(after, row)  # an earlier, different search
    expected = [last_phone_after(uninterrupted, row) for row in rows]
    beginning = [last_phone_after(before, row) for row in rows[:at]]
    after.copy_state(before)
    for decoder in (after, before):
        assert beginning + [last_phone_after(decoder, row) for row in rows[at:]] == expected
        assert decoder.path_since(0) == uninterrupted.path_since(0)
        assert decoder.final_path() == uninterrupted.final_path()


def scores_of(topology: Topology, phones: list[str], frames_per_state: int) -> np.ndarray:
    """Make scores that only fit some phones."""
    states = [
        state
        for phone in (topology.inventory.index[symbol] for symbol in phones)
        for state in range(topology.first_state[phone], topology.first_state[phone + 1])
    ]
    rows = np.full((len(states), topology.num_states), -20.0, np.float32)
    rows[np.arange(len(states)), states] = 0.0
    return rows.repeat(frames_per_state, axis=0)


def test_surplus_phones_are_withdrawn() -> None:
    topology = load_model().topology
    rows = scores_of(topology, ["h", "ao", "m", "a"], 10)
    other = scores_of(topology, ["b", "a", "d", "e", "g", "u"], 1)
    decoder = LiveDecoder(topology, OutputRuleConfig(1, 0.0))
    outputs = decoder.decode([SpeechStart(0)])
    for start in range(0, len(rows), 10):
        outputs += decoder.decode([FrameScores(rows[start : start + 10], other)])
    outputs += decoder.decode([FrameScores(rows[:0], other[:0]), SpeechEnd(len(rows))])
    phones = [output for output in outputs if isinstance(output, Phone)]
    finals = [phone for phone in phones if phone.final]
    assert [phone.index for phone in finals] == list(range(len(finals)))
    assert {phone.index for phone in phones} == {phone.index for phone in finals}
    withdrawn = [phone for phone in finals if phone.is_withdrawn]
    assert len(withdrawn) > 1
    assert {phone.symbol for phone in withdrawn} == {topology.inventory.silence}
    spoken = [phone.symbol for phone in finals if phone.is_spoken]
    assert spoken == ["h", "ao", "m", "a"]
