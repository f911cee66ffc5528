"""Outputs are complete or absent; commands reject useless options, and overwrite no input."""

import errno
import os
import resource
import select
from collections.abc import Iterator
from pathlib import Path
from typing import cast
from unittest import mock

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from kouxing.services.cli import web_model
from kouxing.services.cli.main import app
from kouxing.services.cli.options import ExportOptions
from kouxing.services.cli.recordings.animation import FaceMotion
from kouxing.services.cli.recordings.batch import pair_outputs, process_all
from kouxing.services.cli.recordings.curve_exporters import CURVE_EXPORTERS, FrameStream
from kouxing.services.cli.system.running_system import lock_output_folder
from kouxing.services.driver.video import video_writer
from kouxing.services.driver.video.film import TimedFaps
from kouxing.services.driver.video.video_writer import PictureSequence
from kouxing.shared.command.terminal import check_output, write_text
from kouxing.shared.errors import UserError
from kouxing.shared.files import output_file
from kouxing.shared.files.output_file import open_output, write_error
from tests.system import VOWELS_FILE


def test_an_existing_output_needs_force(tmp_path: Path) -> None:
    path = tmp_path / "face.mp4"
    check_output(path)
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(UserError, match=r"face\.mp4 exists; add --force to overwrite it"):
        check_output(path)
    check_output(path, force=True)
    assert path.read_text() == "mine"


def test_a_file_that_cannot_be_renamed_over_is_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mounted.mp4"
    path.write_text("old")
    busy = OSError(errno.EBUSY, os.strerror(errno.EBUSY))
    monkeypatch.setattr(Path, "replace", mock.Mock(side_effect=busy))
    with open_output(path) as file:
        file.write(b"new")
    assert path.read_text() == "new"
    assert [*tmp_path.iterdir()] == [path]


def test_checking_a_link_to_a_new_file_changes_nothing(tmp_path: Path) -> None:
    link = tmp_path / "link.csv"
    link.symlink_to(tmp_path / "new.csv")
    check_output(link)
    assert [*tmp_path.iterdir()] == [link]


def test_an_output_is_never_an_input(tmp_path: Path) -> None:
    source, link = tmp_path / "me.mp4", tmp_path / "link.mp4"
    source.touch()
    link.symlink_to(source)
    with pytest.raises(UserError, match="the output is also an input"):
        check_output(link, inputs=[None, source, Path("a" * 5000)], force=True)


@pytest.mark.parametrize(
    "arguments",
    [
        "render me.wav my.glb --head my.glb",
        "render me.wav my.csv --text my.csv",
        "render me.csv my.mp4 --sound my.mp4",
        "evaluate recognizer --manifest my.json --json my.json",
        "train phone-lm --text my.txt -o my.txt",
    ],
)
def test_no_option_of_a_command_is_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for argument in arguments.split():
        if "." in argument:
            Path(argument).touch()
    with pytest.raises(UserError, match="the output is also an input"):
        app([*arguments.split(), "--force"], standalone_mode=False)


@pytest.fixture
def old_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    video = Path("out/demo.mp4")
    video.parent.mkdir()
    video.write_bytes(b"mine")
    return video


@pytest.mark.parametrize(
    ("played", "message"),
    [
        ("missing.wav", r"missing\.wav: no such file"),
        ("out/demo.mp4", "the video would overwrite this file"),
    ],
)
def test_run_keeps_the_last_video_if_the_sound_cannot_be_played(
    old_video: Path, played: str, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        app(["run", "--play", played], standalone_mode=False)
    assert old_video.read_bytes() == b"mine"


def test_run_keeps_the_video_of_another_running_system(old_video: Path) -> None:
    with (
        lock_output_folder(old_video.parent),
        pytest.raises(UserError, match="another kouxing writes its logs and videos"),
    ):
        app(["run", "--play", str(VOWELS_FILE)], standalone_mode=False)
    assert old_video.read_bytes() == b"mine"


def test_standard_output_is_not_a_file() -> None:
    with pytest.raises(UserError, match="cannot write to standard output; name a file"):
        check_output(Path("-"))


def test_many_files_go_next_to_their_sources_or_into_a_folder(tmp_path: Path) -> None:
    sources = [tmp_path / "a.wav", tmp_path / "b.m4a"]
    targets = [target for _, target in pair_outputs(sources, None, ".mp4")]
    assert targets == [tmp_path / "a.mp4", tmp_path / "b.mp4"]
    assert pair_outputs(sources, tmp_path / "out", ".csv")[1][1] == tmp_path / "out" / "b.csv"
    assert (tmp_path / "out").is_dir()
    single = pair_outputs(sources[:1], tmp_path / "one", ".mp4")
    assert single == [(sources[0], tmp_path / "one" / "a.mp4")]
    assert pair_outputs(sources[:1], tmp_path / "b.mp4", ".mp4")[0][1] == tmp_path / "b.mp4"
    with pytest.raises(UserError, match=r"a\.wav and .*a\.mp3 would both be written to"):
        pair_outputs([tmp_path / "a.wav", tmp_path / "a.mp3"], None, ".mp4")
    with pytest.raises(UserError, match=r"would both be written to"):
        pair_outputs([tmp_path / "a.wav", tmp_path / "out/../a.wav"], None, ".mp4")
    with pytest.raises(
        UserError, match=r"one\.csv is a single file, but there are 2 inputs; use a folder"
    ):
        pair_outputs(sources, tmp_path / "one.csv", ".csv")
    with pytest.raises(UserError, match=r"a\.wav is named twice"):
        pair_outputs([tmp_path / "a.wav"] * 2, tmp_path / "unused", ".csv")
    assert not (tmp_path / "unused").exists()


def test_the_output_of_standard_input_has_a_name_that_is_not_an_option() -> None:
    assert pair_outputs([Path("-")], None, ".mp4") == [(Path("-"), Path("stdin.mp4"))]


def test_a_bad_file_does_not_stop_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    done = []

    def process(source: Path, _: Path) -> None:
        if source.name == "bad":
            raise UserError("bad: no sound")
        done.append(source.name)

    with pytest.raises(UserError, match="1 of 3 files failed"):
        process_all([(Path(name), Path("x")) for name in ("a", "bad", "c")], process)
    assert done == ["a", "c"]
    assert "bad: no sound" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("speak a.wav --rate 8000", "--rate applies to raw samples; add --raw"),
        ("speak a.wav --raw --track 2", "--track does not apply to raw samples"),
        ("speak a.wav --raw --rate 0", "0 Hz is too low for speech"),
        ("speak a.wav --device USB", "speak mic --device NAME"),
        ("speak mic --fast", "--fast does not apply to mic"),
        ("speak monitor --raw", "--raw does not apply to monitor"),
        ("lips a.wav mouth.png --timing align", "--timing needs a text"),
        ("listen --as phones -o a.csv", "--output does not apply to phones"),
        ("render a.wav me.avi", "me.avi: unknown format; use a name that ends in .mp4"),
        ("render a.wav me.csv --lips lerned", "unknown lip model 'lerned'; use one of"),
        ("align a.wav 啊 -o said.xml", "ends in .txt, .csv, .json, .textgrid"),
        ("render a.wav -o -", "-: cannot write to standard output; name a file"),
        ("render a.wav -o labels", "cannot write labels: labels is not a folder"),
        ("phones a.wav -o labels --format csv", "cannot write labels: labels is not a folder"),
        ("align a.wav 啊 -o labels", "cannot write labels: labels is not a folder"),
        ("plot heads .", "faces.webp exists; add --force"),
        ("express demo --hold 2", "--hold needs an expression"),
        ("express joy:0.4", "for example joy=0.4"),
        ("run --stop-after", "--stop-after needs --play FILE"),
        ("run --track 0", "--track needs --play FILE"),
        ("head export . --head ada", "leave out --head"),
        ("train --any-license heads --parts . -o .", "--any-license does not apply to heads"),
        ("keys add tablet", "tablet.key exists; add --force"),
        ("keys add host/1", "'host/1' is not a valid name"),
        ("keys add host --role service:recogniser", "no service 'recogniser'; choose one of"),
        ("evaluate schemes --from-csv . --videos .", "add --videos FOLDER and --clips"),
        ("evaluate lips --clips . --from-csv . --delay-ms 9", "--delay-ms applies to lip models"),
    ],
)
def test_refuses_arguments_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.wav", "labels", "tablet.key", "faces.webp"):
        Path(name).touch()
    error = CliRunner().invoke(app, arguments.split()).exception
    assert isinstance(error, UserError), error
    assert message in str(error)


def test_the_key_of_several_services_has_a_place_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    roles = ["--role", "service:recognizer", "--role", "service:synthesizer"]
    printed = CliRunner().invoke(app, ["keys", "add", "worker", *roles]).output
    places = "/kouxing/recognizer.key and ~/.local/state/kouxing/synthesizer.key on the other"
    assert places in printed


def fill_the_disk(path: Path) -> None:
    with open_output(path) as file:
        file.write(b"glTF")
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_file_is_deleted_if_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "head.glb"
    with pytest.raises(UserError, match="the disk is full"):
        fill_the_disk(path)
    assert not path.exists()


def test_a_file_without_permission_has_a_remedy() -> None:
    denied = PermissionError(errno.EACCES, "Permission denied")
    text = "cannot write out/a.csv: Permission denied; choose another folder"
    assert str(write_error(Path("out/a.csv"), denied)) == text


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "new"):
        error = CliRunner().invoke(app, ["export", "web", str(folder)]).exception
        assert f"cannot write {folder}: {tmp_path / 'file'} is not a folder;" in str(error)


def test_a_failed_export_keeps_the_older_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_model, "web_model", lambda: {"encoder.onnx": bytes(100_000)})
    older = tmp_path / "encoder.onnx"
    older.write_bytes(b"older")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        result = CliRunner().invoke(app, ["export", "web", str(tmp_path), "--force"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert isinstance(result.exception, UserError)
    assert "cannot write" in str(result.exception)
    assert [*tmp_path.iterdir()] == [older]
    assert older.read_bytes() == b"older"


def test_removes_the_unfinished_file_of_a_killed_process_only(tmp_path: Path) -> None:
    path = tmp_path / "head.glb"
    stale, foreign = (tmp_path / f".{name}.0123abcd.part" for name in ("head.glb", "other.glb"))
    for unfinished in (stale, foreign):
        unfinished.touch()
    with open_output(path) as outer:
        assert not stale.exists()
        with open_output(path) as inner:  # such as that of another process
            inner.write(b"inner")
        outer.write(b"outer")
    assert path.read_bytes() == b"outer"
    assert {*tmp_path.iterdir()} == {path, foreign}


def interrupted_frames() -> Iterator[TimedFaps]:
    yield 0.0, np.zeros(68, np.float32)
    raise KeyboardInterrupt


def interrupt_export(output: Path) -> None:
    exporter = CURVE_EXPORTERS[output.suffix](output, ExportOptions())
    with pytest.raises(KeyboardInterrupt):
        exporter.export(
            FaceMotion(cast(list[TimedFaps], interrupted_frames()), 50.0, 25.0, None), Progress()
        )


@pytest.mark.parametrize("name", ["face.fap", "face.csv"])
@pytest.mark.parametrize("is_new", [False, True])
def test_an_interrupted_command_keeps_the_old_output_or_none(
    tmp_path: Path, name: str, is_new: bool
) -> None:
    output = tmp_path / name
    if not is_new:
        output.write_text("old")
    interrupt_export(output)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"] * (not is_new)


def test_a_new_file_has_the_permissions_of_the_old_one(tmp_path: Path) -> None:
    output = tmp_path / "face.csv"
    output.write_text("old")
    output.chmod(0o640)
    write_text(output, "new")
    assert (output.read_text(), output.stat().st_mode & 0o777) == ("new", 0o640)


def test_links_and_pipes_are_written_directly(tmp_path: Path) -> None:
    link, target, pipe = tmp_path / "link.csv", tmp_path / "face.csv", tmp_path / "pipe.csv"
    link.symlink_to(target)
    write_text(link, "new")
    assert (link.is_symlink(), target.read_text()) == (True, "new")
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with os.fdopen(reader, encoding="utf-8") as text:
        write_text(pipe, "new")
        assert (pipe.is_fifo(), text.read()) == (True, "new")


def test_the_check_of_a_pipe_does_not_end_its_reader(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as reader:
        poll = select.poll()
        poll.register(reader)
        check_output(pipe)
        assert poll.poll(0) == []


def test_an_error_removes_neither_a_link_nor_its_target(tmp_path: Path) -> None:
    link, target = tmp_path / "link.glb", tmp_path / "head.glb"
    link.symlink_to(target)
    with pytest.raises(UserError, match="the disk is full"):
        fill_the_disk(link)
    assert (link.is_symlink(), target.exists()) == (True, True)


def test_an_interrupted_live_table_keeps_its_frames(tmp_path: Path) -> None:
    output = tmp_path / "face.csv"
    rows = ((time_s, 0, faps) for time_s, faps in interrupted_frames())
    with pytest.raises(KeyboardInterrupt):
        CURVE_EXPORTERS[".csv"](output, ExportOptions()).write(FrameStream(rows, is_live=True))
    assert len(output.read_text().splitlines()) == 2


@pytest.mark.parametrize("output", ["pictures", "face%03d.png"])
def test_a_sequence_of_pictures_is_overwritten_only_with_force(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pictures").mkdir()
    Path("pictures/00007.png").touch()
    Path("face007.png").touch()
    with pytest.raises(UserError, match=r"007\.png exists; add --force to overwrite it"):
        app(["render", "my.wav", output], standalone_mode=False)
    for name in ("pictures/00008.png", "pictures/00009.png", "face008.png", "face009.png"):
        Path(name).touch()
    with pytest.raises(
        UserError, match=r"007\.png and 2 more exist; add --force to overwrite them"
    ):
        app(["render", "my.wav", output], standalone_mode=False)


def test_a_sequence_of_pictures_replaces_a_longer_one(tmp_path: Path) -> None:
    others = {"face.png", "face1.png", "face0001.jpg", "face00002.png", "myface0003.png"}
    for name in (*others, "face0000.png", "face0005.png", "face10000.png"):
        (tmp_path / name).touch()
    sequence = PictureSequence(tmp_path / "face%04d.png")
    sequence.write_image(np.zeros((2, 2, 3), np.uint8))
    assert (tmp_path / "face0005.png").exists()  # until the new sequence is complete
    sequence.close()
    assert {path.name for path in tmp_path.iterdir()} == {*others, "face0000.png"}
    assert (tmp_path / "face0000.png").stat().st_size > 0


def test_a_sequence_of_pictures_searches_its_folder_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searches: list[Path] = []
    for module in (output_file, video_writer):
        monkeypatch.setattr(module, "remove_unfinished", lambda path, *_: searches.append(path))
    for path, folder in ((tmp_path / "new", tmp_path / "new"), (tmp_path / "%d.png", tmp_path)):
        sequence = PictureSequence(path)
        for _ in range(2):
            sequence.write_image(np.zeros((2, 2, 3), np.uint8))
        assert searches.pop() == folder
        assert searches == []


@pytest.mark.parametrize("name", ["my heads/head.glb", "link.glb"])
def test_an_error_names_the_folder_to_create(tmp_path: Path, name: str) -> None:
    (tmp_path / "link.glb").symlink_to(tmp_path / "my heads" / "head.glb")
    command = f"mkdir -p '{tmp_path}/my heads'"
    with pytest.raises(UserError, match=command), open_output(tmp_path / name):
        pass


def test_a_device_is_not_deleted() -> None:
    with pytest.raises(UserError, match="the disk is full"), open_output(Path("/dev/full")) as file:
        file.write(b"text")
    assert Path("/dev/full").exists()
