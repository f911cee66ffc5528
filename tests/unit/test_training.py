"""Corpora, estimation and alignment on small made-up speech."""

import itertools
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
from typer.testing import CliRunner

from kouxing.corpora.speech_corpus import RowErrors, may_distribute, read_corpus
from kouxing.corpora.tables import read_rows
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.forced_path import build_utterance_graph, viterbi_path
from kouxing.shared.errors import UserError
from kouxing.training.commands import app
from kouxing.training.gmm.recipe import train_gmm
from kouxing.training.phone_lm.recipe import load_phone_lm, train_phone_lm
from tests.corpora import write_manifest
from tests.languages import MANDARIN, SIL


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


# --- corpora


def write_corpus(folder: Path, rows: list[str], num_audio: int = 3) -> None:
    columns = "utt_id path speaker source licence split seconds text pinyin"
    write_manifest(folder, columns, rows)
    rng = np.random.default_rng(0)
    for number in range(num_audio):
        sound = np.concatenate([np.zeros(4000), rng.normal(0, 0.1, 12_000), np.zeros(4000)])
        soundfile.write(folder / f"{number}.wav", sound, 16_000)


def test_reads_a_kaldi_folder(tmp_path: Path) -> None:
    write_corpus(tmp_path, [])
    (tmp_path / "manifest.tsv").unlink()
    (tmp_path / "wav.scp").write_text(f"u1\t0.wav\nu2 {tmp_path}/1.wav\n")
    (tmp_path / "text").write_text("u1 你好\nu2 你 好 吗\n", encoding="utf-8")
    (tmp_path / "utt2spk").write_text("u1 anna\nu2 bob\n")
    rows = read_corpus(tmp_path, RowErrors(), MANDARIN)
    assert [(u.utterance_id, u.speaker, len(u.phones)) for u in rows] == [
        ("u1", "anna", 4),
        ("u2", "bob", 6),
    ]
    assert rows[0].seconds == pytest.approx(1.25)
    assert {u.split for u in rows} == {"train"}
    (tmp_path / "wav.scp").write_text("u1 0.wav\nu2 sph2pipe 1.sph |\nu3 1.wav\n")
    errors = RowErrors()
    held_out = tmp_path.rename(tmp_path.with_name("test"))
    rows = read_corpus(held_out, errors, MANDARIN, split="test")
    assert [u.utterance_id for u in rows] == ["u1"]
    assert "line 2 (u2): commands are not supported" in errors.messages[0]
    assert "line 3 (u3): no text" in errors.messages[1]
    errors = RowErrors()
    assert read_corpus(held_out, errors, MANDARIN, split="train") == []
    text = str(errors.no_recording_error("in the split 'train'"))
    assert text == "no usable recordings in the split 'train'; rows by split: test (3)"
    (held_out / "text").unlink()
    with pytest.raises(UserError, match="text: no such file"):
        read_corpus(held_out, RowErrors(), MANDARIN)
    (held_out / "segments").write_text("u1-1 u1 0 1\n")
    with pytest.raises(UserError, match="segments"):
        read_corpus(held_out, RowErrors(), MANDARIN)


def test_reads_an_aishell_folder(tmp_path: Path) -> None:
    (tmp_path / "wav" / "train" / "S0002").mkdir(parents=True)
    (tmp_path / "transcript").mkdir()
    sound = np.zeros(16_000)
    soundfile.write(tmp_path / "wav/train/S0002/BAC009S0002W0122.wav", sound, 16_000)
    transcript = tmp_path / "transcript" / "aishell_transcript_v0.8.txt"
    transcript.write_text("BAC009S0002W0122 而 对\nBAC009S0002W0123 无声\n", encoding="utf-8")
    errors = RowErrors()
    rows = read_corpus(tmp_path, errors, MANDARIN, split="train")
    assert [(u.speaker, u.split, u.license) for u in rows] == [("S0002", "train", "Apache-2.0")]
    assert "BAC009S0002W0123" in errors.messages[0]


def test_rejects_folders_without_a_corpus(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a corpus"):
        read_corpus(tmp_path, RowErrors(), MANDARIN)
    write_manifest(tmp_path, "utt_id path")
    with pytest.raises(UserError, match="lacks the column pinyin or text"):
        read_corpus(tmp_path, RowErrors(), MANDARIN)
    (tmp_path / "manifest.tsv").write_bytes("utt_id\tpath\tpinyin\n你".encode("gb18030"))
    with pytest.raises(UserError, match="not UTF-8 text"):
        read_corpus(tmp_path, RowErrors(), MANDARIN)
    write_manifest(tmp_path, "utt_id path pinyin", ["1\ta.wav\t" + "a" * 200_000])
    with pytest.raises(UserError, match=r"manifest\.tsv: the file is damaged or is not a table"):
        read_corpus(tmp_path, RowErrors(), MANDARIN)


def test_a_table_may_have_empty_lines(tmp_path: Path) -> None:
    (tmp_path / "a.tsv").write_text("\n\na\tb\n1\t2\n \n")
    assert read_rows(tmp_path / "a.tsv", ("a", "b")) == [{"a": "1", "b": "2"}]


def test_licenses_that_allow_distribution() -> None:
    for free in (
        "Apache-2.0 (AISHELL-1/OpenSLR33)", "MIT", "CC0-1.0 (Common Voice)", "CC-BY-SA (shtooka)",
        "CC BY 4.0", "Unlicense (public domain)", "synthetic (Kokoro-82M, Apache-2.0)",
    ):  # fmt: skip
        assert may_distribute(free), free
    for closed in (
        "CC-BY-NC-ND-4.0", "CC BY-NC 4.0", "CC BY-SA-NC", "Apache-2.0 with exceptions", "",
        "MIT (repo); film clip", "MIT (repo sample); YouTube footage", "all rights reserved",
        "not CC0", "MIT-style, research only",
    ):  # fmt: skip
        assert not may_distribute(closed), closed


# --- paths


@pytest.mark.parametrize("seed", range(2))
def test_alignment_is_the_best_of_all_paths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first_state = np.arange(len(MANDARIN) + 1)  # one state each: sil a sil b sil
    graph = build_utterance_graph([22, 30], [1, 1], first_state, silence=SIL)
    num_frames = 6
    scores = rng.normal(0, 2, (num_frames, len(graph.states))).astype(np.float32)
    stay = rng.uniform(0.2, 0.8, len(MANDARIN))
    log_stay, log_leave = np.log(stay), np.log(1 - stay)
    allowed = {(0, 1), (1, 2), (1, 3), (2, 3), (3, 4)}
    best = -np.inf
    for sequence in itertools.product(range(len(graph.states)), repeat=num_frames):
        if sequence[0] not in (0, 1) or sequence[-1] not in (3, 4):
            continue
        total = sum(scores[t, p] for t, p in enumerate(sequence))
        for a, b in itertools.pairwise(sequence):
            if a == b:
                total += log_stay[graph.states[a]]
            elif (a, b) in allowed:
                total += log_leave[graph.states[a]]
            else:
                total = -np.inf
        best = max(best, total + log_leave[graph.states[sequence[-1]]])
    path, path_score = viterbi_path(
        scores,
        np.arange(len(graph.states)),
        graph,
        log_stay.astype(np.float32),
        log_leave.astype(np.float32),
    )
    assert path_score == pytest.approx(best, rel=1e-4)
    assert len(path) == num_frames


# --- whole recipes


def test_trains_models_and_writes_cards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        f"{n}\t{n}.wav\tS{n}\tx\tCC0-1.0\t{'dev' if n == 5 else 'train'}\t1.25\t你好\tni3 hao3"
        for n in range(6)
    ]
    bad = "bad\tbad.wav\tS\tx\tCC0\ttrain\t1\t你\tni3"
    closed = "closed\t0.wav\tS\tx\tCC BY-NC\ttrain\t1.25\t你好\tni3 hao3"
    write_corpus(tmp_path / "corpus", [*rows, bad, closed], 6)
    gmm = tmp_path / "gmm.npz"
    train = partial(train_gmm, [tmp_path / "corpus"], inventory=MANDARIN, any_license=False)
    train(gmm, num_mixtures=2)
    messages = capsys.readouterr().err
    assert messages.endswith("2 rows skipped\n")
    assert "(closed): its license (CC BY-NC)" in messages
    assert "'kouxing train --any-license' uses it" in messages
    assert "CC0-1.0" in gmm.with_suffix(".md").read_text()
    again = tmp_path / "again.npz"
    train(again, num_mixtures=2)
    assert again.read_bytes() == gmm.read_bytes()  # the same seed, the same model
    text = tmp_path / "text.txt"
    text.write_text("欢迎来到口型。\n" * 3, encoding="utf-8")
    train_phone_lm([], [text], tmp_path / "lm.npz", MANDARIN)
    lm = tmp_path / "lm.npz"
    train(again, phone_lm=lm, num_mixtures=1)
    welcome = load_phone_lm(tmp_path / "lm.npz", MANDARIN)
    known = {path: load_model(path).topology.phone_lm for path in (gmm, again)}
    np.testing.assert_array_equal(known[again].phone, welcome.phone)
    np.testing.assert_array_equal(known[again].log_prob, welcome.log_prob)
    assert len(known[gmm].phone) < len(welcome.phone)


@pytest.mark.parametrize("options", [[], ["--any-license"]])
def test_an_option_of_the_group_permits_any_license(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    permitted = []

    def train(*_: Path, any_license: bool) -> None:
        permitted.append(any_license)

    monkeypatch.setattr("kouxing.training.visemes.recipe.train_visemes", train)
    arguments = ["visemes", "--clips", str(tmp_path), "-o", str(tmp_path / "visemes.json")]
    CliRunner().invoke(app, [*options, *arguments], catch_exceptions=False)
    assert permitted == [bool(options)]
