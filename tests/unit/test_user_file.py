"""Every reader of a user's file accepts regular files only, and reports bad contents."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.corpora.commands import _read as read_speech
from kouxing.corpora.lip_clips import read_clip
from kouxing.corpora.speech_corpus import RowErrors, read_corpus
from kouxing.evaluation.mos.study import load_study
from kouxing.services.cli.configuration import config
from kouxing.services.cli.recordings.animation import read_motion
from kouxing.services.cli.texts.spoken_text import read_spoken_text, read_transcript
from kouxing.services.driver.head.feature_points_file import read_points
from kouxing.services.driver.head.mesh_file import read_mesh
from kouxing.services.driver.render.scene import load_head
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.mouth_profile import read_mouth_profile
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.shared.audio.audio_file import (
    check_video,
    limited_blocks,
    open_audio,
    read_audio,
    read_duration_s,
)
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import open_file, parse_json, read_file, read_text
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.settings.keys import read_key


def read_manifest(path: Path) -> None:
    read_corpus(path, RowErrors(), load_inventory())


READERS: list[tuple[str, Callable[[Path], object]]] = [
    ("a.fap", lambda path: read_motion(path, None)),
    ("a.csv", lambda path: read_motion(path, None)),
    ("a.jsonl", lambda path: read_motion(path, None)),
    ("a.txt", lambda path: read_spoken_text(str(path))),
    ("a.glb", lambda path: load_head(str(path))),
    ("a.gltf", lambda path: load_head(str(path))),
    ("a.ply", read_mesh),
    ("a.obj", read_mesh),
    ("a.fdp", read_points),
    ("a.mouth", read_mouth_profile),
    ("a.landmarks", read_speech),
    ("a.toml", lambda path: config(config=path)),
    ("a.key", read_key),
    ("a.npz", load_model),
    ("a.json", read_clip),
    ("b.json", load_parameters),
    ("study.json", lambda path: load_study(path.parent)),
    ("a.tsv", read_manifest),
    ("a.mp4", check_video),
    ("a.wav", read_duration_s),
]


@pytest.mark.parametrize(("name", "read"), READERS, ids=[name for name, _ in READERS])
def test_readers_reject_a_fifo(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / name, 0o600)
    with pytest.raises(UserError, match=r"pipe or device|not a regular file"):
        read(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "read"), [row for row in READERS if row[0].endswith(("l", "n", "y"))]
)
def test_readers_report_deeply_nested_files(
    tmp_path: Path, name: str, read: Callable[[Path], object]
) -> None:
    (tmp_path / name).write_text("[" * 50_000)
    (tmp_path / name).chmod(0o600)
    with pytest.raises(UserError, match=name):
        read(tmp_path / name)


def test_open_file_rejects_everything_but_small_regular_files(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(bytes(2000))
    (tmp_path / "device").symlink_to("/dev/zero")
    for path, message in (
        (tmp_path, "this is a folder"),
        (tmp_path / "device", "this is a pipe or device"),
        (tmp_path / "none", "no such file"),
        (Path("https://example.com/a.mp3"), "this is a URL; download the file first"),
        (tmp_path / "file", "larger than 1 KiB"),
        (tmp_path / ("x" * 300), "too long"),
        (tmp_path / "\0", "null byte"),
    ):
        with pytest.raises(UserError, match=message):
            open_file(path, 1024)
    with pytest.raises(UserError, match="this is a pipe or device"):
        open_audio(tmp_path / "device")


@pytest.mark.parametrize("name", ["a.csv", "a.fap", "a.tsv"])
def test_lines_of_tables_are_limited(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("utt_id" * 200_000)
    with pytest.raises(UserError, match="line 1 has more than 1000000 characters"):
        dict(READERS)[name](tmp_path / name)


def test_a_file_of_the_kernel_is_empty() -> None:
    assert read_file(Path("/proc/self/pagemap"), 1) == b""


def test_text_must_be_utf_8(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes("\ufeff你".encode())
    assert read_text(tmp_path / "a", 100) == "你"
    (tmp_path / "a").write_bytes("你".encode("gb18030"))
    with pytest.raises(UserError, match="not UTF-8 text"):
        read_text(tmp_path / "a", 100)


@pytest.mark.parametrize("text", ["[" * 100_000, "[" + "[]," * 1_000_000 + "1]", "{"])
def test_json_is_limited(text: str) -> None:
    with pytest.raises(ValueError, match=r"nested|values|Expecting"):
        parse_json(text)


def test_the_duration_of_a_recording_is_limited(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.flac", np.zeros(16_000, np.float32), 16_000)
    with pytest.raises(UserError, match=r"longer than 0\.0001 h"):
        list(limited_blocks(open_audio(tmp_path / "a.flac"), 0.36))
    assert len(read_audio(tmp_path / "a.flac")[0]) == 16_000


def test_a_sample_rate_must_be_possible(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", np.zeros(16_000, np.float32), 16_000)
    content = bytearray((tmp_path / "a.wav").read_bytes())
    content[24:28] = (2**31 - 1).to_bytes(4, "little")
    (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(UserError, match="the sample rate is 2147483647 Hz"):
        read_audio(tmp_path / "a.wav")


@pytest.mark.parametrize("text", ["1" * 10_001, "你" * 150_001])
def test_a_spoken_text_is_limited(text: str) -> None:
    with pytest.raises(UserError, match="the spoken text has more than"):
        read_transcript(text, load_inventory())


def test_a_long_word_of_pinyin_is_not_read() -> None:
    assert len(load_inventory().read("ni3hao3 " + "ni3hao3" * 1000).dropped) == 1


@pytest.mark.parametrize("place", ["fifo", "../a.mtl", "/dev/zero", "device"])
def test_a_mesh_names_only_regular_files_in_its_folder(tmp_path: Path, place: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "a.mtl").touch()
    os.mkfifo(tmp_path / "in" / "fifo")
    (tmp_path / "in" / "device").symlink_to("/dev/zero")
    mesh = tmp_path / "in" / "a.obj"
    mesh.write_text(f"mtllib {place}\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(UserError, match=place):
        read_mesh(mesh)
