"""Phone language models counted from texts, corpora and a language model of words."""

import struct
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kouxing.shared.errors import UserError
from kouxing.training.phone_lm import open_gram
from kouxing.training.phone_lm.open_gram import DICTIONARY, NGRAMS, draw_phones
from kouxing.training.phone_lm.recipe import (
    PhoneStream,
    estimate_phone_lm,
    join_sentences,
    load_phone_lm,
    phones_of_text,
    train_phone_lm,
)
from tests.corpora import write_manifest
from tests.languages import MANDARIN, NUM_PHONES, SIL, START, Table, step

INDEX = MANDARIN.index
# the corpus's sentence of split train
SENTENCE = [
    INDEX[phone]
    for syllable in MANDARIN.pronounce("mei3 yi2 ge4 zi4 dou1 you2")
    for phone in syllable
]


def trigram_sentences(num_sentences: int = 400, seed: int = 0) -> PhoneStream:
    """Sentences in which two phones tell much about the next."""
    rng = np.random.default_rng(seed)
    likely = rng.dirichlet(np.full(8, 0.2), (8, 8))
    sentences = []
    for length in rng.integers(1, 12, num_sentences):
        sentence = [0, 0]
        for _ in range(length):
            sentence.append(int(rng.choice(8, p=likely[sentence[-2], sentence[-1]])))
        sentences.append([7 * phone for phone in sentence[2:]])
    return join_sentences(sentences, MANDARIN)


# --- estimation


@pytest.mark.parametrize("max_ngrams", [60, 300, 1_000_000])
def test_probabilities_after_every_context_sum_to_one(max_ngrams: int) -> None:
    graph = estimate_phone_lm([trigram_sentences()], MANDARIN, order=4, max_ngrams=max_ngrams).graph
    for context in range(0, len(graph.last_phone), max(1, len(graph.last_phone) // 60)):
        probs = [np.exp(step(graph, context, phone)[0]) for phone in range(NUM_PHONES)]
        assert sum(probs) == pytest.approx(1, abs=1e-3)
        assert min(probs) > 0


def test_smooths_like_witten_and_bell() -> None:
    """After 1 2 comes 3 eight times and 4 twice, after 5 2 only 4: eq. as in the docstring."""
    sentences = [[1, 2, 3]] * 8 + [[1, 2, 4]] * 2 + [[5, 2, 4]] * 10
    graph = estimate_phone_lm([join_sentences(sentences, MANDARIN)], MANDARIN, order=3).graph
    num_phones = 3 * 20 + 20 - 1  # the pause before the first sentence is not counted
    alone = {3: 8.5, 4: 12.5}
    after_2 = {u: ((8, 12)[u == 4] + 2 * alone[u] / (num_phones + 30)) / 22 for u in (3, 4)}
    _, after_1 = step(graph, START, 1)
    _, after_1_2 = step(graph, after_1, 2)
    for phone, count in ((3, 8), (4, 2)):
        prob = np.exp(step(graph, after_1_2, phone)[0])
        assert prob == pytest.approx((count + 2 * after_2[phone]) / 12, rel=1e-4)
    assert graph.last_phone[after_1_2] == 2
    assert step(graph, after_1_2, 3) > step(graph, after_1_2, 4)
    _, after_5_2 = step(graph, step(graph, START, 5)[1], 2)
    assert step(graph, after_5_2, 4) > step(graph, after_5_2, 3)


# --- words drawn from a language model

WORDS = ("", "，", "你好", "中国", "人", "abc")
SINGLE = {0: 0.05, 1: 0.05, 2: 0.15, 3: 0.3, 4: 0.4, 5: 0.05}
PAIRS = {(2, 3): 0.9, (3, 4): 0.5}
TRIPLES = {(2, 3, 4): 0.95}


def write_ngrams(path: Path) -> Path:
    """Write as `tslminfo -v` does."""

    def row(words: tuple[int, ...], prob: float, rest: str = "0.25 ") -> str:
        numbers = "".join(f"{word:8d} " for word in words)
        return f"{numbers}{-np.log(prob):.6f} {rest}(0,{len(words)})\n"

    levels = [
        "\\0-gram\\1\n" + row((), 1.0),
        f"\\1-gram\\{len(SINGLE)}\n" + "".join(row((w,), prob) for w, prob in SINGLE.items()),
        f"\\2-gram\\{len(PAIRS)}\n" + "".join(row(words, prob) for words, prob in PAIRS.items()),
        f"\\3-gram\\{len(TRIPLES)}\n" + "".join(row(w, prob, "") for w, prob in TRIPLES.items()),
    ]
    path.write_text("".join(levels), encoding="ascii")
    return path


def write_dictionary(path: Path) -> Path:
    head = struct.pack("<4I", 7, 7, 24, 7) + bytes(8)
    path.write_bytes(head + "\0".join(WORDS).encode("utf-32-le"))
    return path


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(open_gram, "_NUM_CHAINS", 20)
    write_ngrams(tmp_path / NGRAMS)
    write_dictionary(tmp_path / DICTIONARY)
    return tmp_path


def words_of(stream: PhoneStream) -> list[str]:
    """Read the words back: each begins with a phone of its own."""
    readable = [word for word in WORDS if MANDARIN.readable.fullmatch(word)]
    words = {phones_of_text(word, MANDARIN): word for word in readable}
    words[SIL,] = ""
    texts: list[str] = []
    left = tuple(stream.tolist())
    while left:
        (phones,) = (phones for phones in words if left[: len(phones)] == phones)
        texts.append(words[phones])
        left = left[len(phones) :]
    return texts


def test_draws_words_with_their_probabilities(model: Path) -> None:
    stream = draw_phones(model, MANDARIN, num_words=8000)
    assert stream.dtype == np.uint8
    assert not ((stream[1:] == SIL) & (stream[:-1] == SIL)).any()
    assert stream[0] == SIL
    words = words_of(stream)
    assert 6500 < len(words) < 8100
    pairs = Counter(pairwise(words))
    hello = sum(count for pair, count in pairs.items() if pair[0] == "你好")
    assert hello > 500
    assert pairs["你好", "中国"] / hello == pytest.approx(0.9, abs=0.04)
    people = [after for before, after in pairwise(words) if before == "人"]
    assert people.count("人") / len(people) == pytest.approx(0.4, abs=0.04)
    # a comma, Latin letters and word 0 are pauses
    assert people.count("") / len(people) == pytest.approx(0.15, abs=0.03)


@pytest.mark.parametrize(
    ("source", "replaced", "message"),
    [
        (DICTIONARY, NGRAMS, "is not output of `tslminfo -v`"),
        (NGRAMS, DICTIONARY, "use files of the same version"),
    ],
)
def test_rejects_a_word_model_of_wrong_files(
    model: Path, source: str, replaced: str, message: str
) -> None:
    (model / replaced).write_bytes((model / source).read_bytes())
    with pytest.raises(UserError, match=message):
        draw_phones(model, MANDARIN, num_words=10)


# --- from files to a file


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    """One sentence that counts, and a word, synthetic speech and a sentence for dev."""
    sentence = "mei3 yi2 ge4 zi4 dou1 you2"
    rows = [
        f"a\ta.wav\tA\tCC0-1.0\ttrain\t9\t{sentence}",
        f"b\ta.wav\tB\tCC0-1.0\ttrain\t9\t{sentence}",
        "c\ta.wav\tA\tCC0-1.0\ttrain\t9\tni3 hao3",
        f"d\ta.wav\tA\tsynthetic\ttrain\t9\t{sentence} zao3",
        f"e\ta.wav\tA\tCC0-1.0\tdev\t9\t{sentence} zao3",
        f"f\tnone.wav\tA\tCC0-1.0\ttrain\t9\t{sentence} zao3",
        f"g\ta.wav\tA\tCC0-1.0\ttrain\t9\t{sentence} zao3\tsynthetic",
    ]
    columns = "utt_id path speaker license split seconds pinyin kind"
    folder = write_manifest(tmp_path / "corpus", columns, rows).parent
    (folder / "a.wav").touch()
    return folder


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_trains_on_texts_and_corpora(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = written(tmp_path / "a.txt", "你好，中国人。\nHello 你好！\n鿋，好\n" * 5)
    output = tmp_path / "lm.npz"
    train_phone_lm([corpus], [text], output, MANDARIN)
    lines = [
        line for line in capsys.readouterr().err.splitlines() if "phones" in line or "row" in line
    ]
    # 你好 has four phones, 中国人 six, 好 two; a pause is before each; the rest cannot be read
    assert lines[0] == (
        f"{5 * (5 + 7 + 5 + 3)} phones of text, {1 + len(SENTENCE)} of sentences of the corpora"
    )
    assert "none.wav; row skipped" in lines[1]
    assert lines[2] == "1 row skipped"
    assert "n-grams of 1 to 6 phones kept: 60, " in lines[3]
    table = Table.of(load_phone_lm(output, MANDARIN))
    n, i, h = (INDEX[phone] for phone in "nih")
    assert (SIL, n, i, h) in table.log_prob
    assert (SIL, *SENTENCE[:5]) in table.log_prob
    assert (INDEX["z"], INDEX["ao"]) not in table.log_prob
    assert max(range(NUM_PHONES), key=lambda phone: table.after((SIL,), phone)) == n
    other = tmp_path / "again.npz"
    train_phone_lm([corpus], [text], other, MANDARIN)
    assert other.read_bytes() == output.read_bytes()


def test_rejects_unreadable_texts_and_empty_input(tmp_path: Path) -> None:
    output = tmp_path / "lm.npz"
    foreign = tmp_path / "foreign.txt"
    foreign.write_bytes("你好".encode("gb18030"))
    with pytest.raises(UserError, match=r"foreign\.txt: this is not UTF-8 text"):
        train_phone_lm([], [foreign], output, MANDARIN)
    with pytest.raises(UserError, match=r"nowhere\.txt: no such file"):
        train_phone_lm([], [tmp_path / "nowhere.txt"], output, MANDARIN)
    latin = written(tmp_path / "latin.txt", "no Chinese\n")
    with pytest.raises(UserError, match="no text to count"):
        train_phone_lm([], [latin], output, MANDARIN)
    with pytest.raises(UserError, match="no text to count"):
        train_phone_lm([], [], output, MANDARIN)
    assert not output.exists()
