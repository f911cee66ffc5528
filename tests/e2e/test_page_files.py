"""The page in a real browser streams audio files and records videos, see ``test_page``."""

import base64
import io
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile
from kouxing_client import Session

from tests.browser import SIZE_PX, Browser
from tests.e2e.page_actions import A_FACE, NOTICE, STATE, choose, colorfulness, is_loud, write_tone
from tests.e2e.page_control import PageControl
from tests.system import wait_until


def choose_file(page: Browser, path: Path) -> None:
    document = page.command("DOM.getDocument")["root"]["nodeId"]
    field = page.command("DOM.querySelector", nodeId=document, selector="#file")["nodeId"]
    page.command("DOM.setFileInputFiles", nodeId=field, files=[str(path)])


def test_a_file_is_streamed_and_the_face_recorded_as_a_video(
    control: PageControl, session: Session, page: Browser, tmp_path: Path
) -> None:
    page.resize(400, 300)  # a small video is encoded faster
    before = {*control.openings}
    control.talk(session.name, A_FACE, "a")
    page.evaluate(
        "window.saved = null; const make = URL.createObjectURL; URL.createObjectURL = (blob) =>"
        " (blob.type.startsWith('video') && (window.saved = blob), make(blob))"
    )
    page.evaluate(
        "const { start } = MediaRecorder.prototype; MediaRecorder.prototype.start = () => {"
        " MediaRecorder.prototype.start = start; throw new Error('no encoder'); }"
    )
    page.click("record")
    page.wait_for(f"{NOTICE}.includes('could not be recorded: no encoder')")
    assert not page.evaluate(f"{STATE}.recording")
    page.click("record")
    page.wait_for(f"{STATE}.recording")
    canvas = "document.getElementById('head')"
    size = page.evaluate(f"[{canvas}.width, {canvas}.height]")
    frames = page.evaluate(f"{STATE}.numFrames")
    page.wait_for(f"{STATE}.numFrames > {frames + 25}")
    page.resize(360, 270)  # the video keeps its size

    write_tone(tmp_path / "tone.wav")
    choose_file(page, tmp_path / "tone.wav")
    wait_until(lambda: {*control.openings} > before)
    (name,) = {*control.openings} - before
    wait_until(lambda: control.has_ended(name))  # at the end of the file
    samples = control.samples(name)
    # a busy page drops late chunks
    assert len(samples) > control.openings[name].sample_rate_hz / 2
    assert is_loud(samples)

    page.wait_for(f"{STATE}.session === 'seen'")
    page.click("record")
    page.wait_for(f"!{STATE}.recording && {NOTICE}.startsWith('Saved')")
    page.resize(*SIZE_PX)
    video = base64.b64decode(
        page.evaluate(
            "window.saved.arrayBuffer().then((data) =>"
            " btoa(Array.from(new Uint8Array(data), (byte) => String.fromCharCode(byte)).join('')))"
        )
    )
    with av.open(io.BytesIO(video), "r") as container:
        kind = "webm" if "webm" in container.format.name else "mp4"
        assert f".{kind}." in page.evaluate(NOTICE)
        assert {stream.type for stream in container.streams} == {"video", "audio"}
        frames = container.decode(video=0)
        images = [np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in frames]
    assert len(images) > 5
    assert {picture.shape for picture in images} == {(size[1], size[0], 3)}
    assert colorfulness(images[-1]).max() > 50  # skin
    assert images[-1][2, 2].min() > 200  # the page's background, not black


@pytest.mark.usefixtures("infrequent_drawing")
@pytest.mark.parametrize(
    ("name", "content", "english", "chinese"),
    [
        (
            f"{'broken' * 20}.wav",
            b"RIFF" + bytes(40),
            "the file is damaged or cut off",
            "文件损坏或不完整",
        ),
        (
            "silent.wav",
            None,
            "No speech was found: silent.wav is silent. Choose another file",
            "请选择其他文件",
        ),
    ],
)
def test_a_file_without_sound_is_explained_in_both_languages(
    page: Browser, tmp_path: Path, name: str, content: bytes | None, english: str, chinese: str
) -> None:
    if content is None:
        soundfile.write(tmp_path / name, np.zeros(16000), 16000)
    else:
        (tmp_path / name).write_bytes(content)
    for language, text in (("zh", chinese), ("en", english)):
        choose(page, "language", language)
        choose_file(page, tmp_path / name)
        page.wait_for(f"{NOTICE}.includes('{text}')")
        notice = "document.getElementById('notice')"
        assert page.evaluate(f"{notice}.scrollWidth <= {notice}.clientWidth")  # long names wrap


@pytest.mark.usefixtures("infrequent_drawing")
def test_reading_of_a_file_is_shown_and_can_be_stopped(page: Browser, tmp_path: Path) -> None:
    write_tone(tmp_path / "tone.wav")
    (tmp_path / "empty.wav").touch()
    choose_file(page, tmp_path / "empty.wav")
    page.wait_for(f"{NOTICE}.includes('empty.wav')")
    page.evaluate("window.realFetch = fetch; void (window.fetch = () => new Promise(() => {}))")
    choose_file(page, tmp_path / "tone.wav")
    busy = "[...document.querySelectorAll('[aria-busy=true]')].map(({ id }) => id).join()"
    page.wait_for(f"{busy} === 'open-file'")
    assert page.evaluate(f"{NOTICE} === ''"), "the error was about another file"
    page.click("open-file")
    page.wait_for(f"{busy} === ''")
    page.evaluate("void (window.fetch = window.realFetch)")


@pytest.mark.usefixtures("infrequent_drawing")
def test_a_dropped_file_is_streamed(
    control: PageControl, session: Session, page: Browser, tmp_path: Path
) -> None:
    before = {*control.openings}
    write_tone(tmp_path / "tone.wav")
    dropped = {"items": [], "files": [str(tmp_path / "tone.wav")], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        page.command("Input.dispatchDragEvent", type=kind, x=240, y=150, data=dropped)
    wait_until(lambda: {*control.openings} > before)
    (name,) = {*control.openings} - before
    wait_until(lambda: control.has_ended(name))
    assert is_loud(control.samples(name))
    page.wait_for(f"{STATE}.session === 'seen'")
