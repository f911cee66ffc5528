"""*Learn my mouth* on the page: camera and microphone in, a mouth profile out.

The profile is really learned. The camera sees one of our own heads, which opens and closes its
mouth.
"""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile
from PIL import Image

from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS
from kouxing.shared.wire.face import FaceSettings, SetFace
from tests import heads
from tests.browser import Browser
from tests.face_landmarks import landmark_file
from tests.fake_control import FakeControl
from tests.heads import neutral_faps
from tests.system import DEMO, Gateway, wait_until

NUM_PICTURES = 8
# On a busy machine, a face is found in too few images. Otherwise, there is too little speech.
REFUSAL = r"film (it for )?\d+ s or more"


def write_speaking_head(path: Path) -> None:
    """Write a second of a head whose mouth opens and closes."""
    renderer = Renderer(heads.load("woman", "coarse"), 320, 240, samples=0)
    rest, opened = neutral_faps(), heads.OPEN_MOUTH
    shares = np.linspace(0, 1, NUM_PICTURES, dtype=np.float32)
    pictures = [renderer.draw(rest + share * (opened - rest)) for share in shares]
    renderer.close()
    with path.open("wb") as file:
        for picture in [*pictures, *reversed(pictures)]:
            for _ in range(2):
                Image.fromarray(picture).convert("RGB").save(file, "JPEG", quality=90)


@pytest.fixture(scope="module")
def control() -> Iterator[FakeControl]:
    with FakeControl() as control:
        yield control


@pytest.fixture(scope="module")
def browser(control: FakeControl, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("browser")
    write_speaking_head(folder / "head.mjpeg")
    gateway = Gateway(control.address)
    browser = Browser(folder, DEMO / "hello-female.wav", folder / "head.mjpeg", (640, 480))
    with browser.infrequent_drawing():  # no test looks at our own face
        browser.open(gateway.page)
        yield browser
    browser.close()
    assert gateway.stop() == 0


def text_of(browser: Browser, name: str) -> str:
    text: str = browser.evaluate(f"document.getElementById('{name}').innerText")
    return text


def set_min_rate(browser: Browser, rate_hz: float) -> None:
    module = "import('/face-recording.js')"
    browser.evaluate(f"{module}.then((it) => {{ it.FaceRecording.minRateHz = {rate_hz} }})")


def slow_down_tracker(browser: Browser) -> None:
    """Let the tracker run after the reading, and record what the page shows when it runs."""
    browser.evaluate(
        "import('/face-tracker.js').then(({ FaceTracker: { prototype } }) => {"
        " const { find } = prototype; window.images = [];"
        " prototype.find = async function (image) {"
        "   images.push([window.kouxing.state.lesson, image.width]);"
        "   await new Promise((resolve) => setTimeout(resolve, 150));"
        "   return find.call(this, image); }; })"
    )


def start_recording(browser: Browser) -> None:
    browser.click("learn")
    browser.click("learn-start")


def read_aloud(browser: Browser) -> None:
    """Record some images, however slowly, and wait for the outcome."""
    set_min_rate(browser, 0)
    browser.evaluate(
        "window.numImages = 0; window.takeImage = createImageBitmap;"
        " window.createImageBitmap = (...args) => { numImages += 1; return takeImage(...args); }; 0"
    )
    browser.evaluate("window.kouxing.readingS = 600")
    start_recording(browser)
    is_due = "document.getElementById('learn-reading').classList.contains('due')"
    browser.wait_for(f"{is_due} && window.numImages > 5", 180)
    browser.evaluate("window.kouxing.readingS = 0.001")
    browser.wait_for("!['reading', 'learning'].includes(window.kouxing.state.lesson)", 90)


def lengthen(recording: bytes) -> bytes:
    """Make a longer recording of the same face, whose lips open with the loudness."""
    size = 4 + int.from_bytes(recording[:4], "little")
    num_frames = json.loads(recording[4:size])["times"]
    points = np.frombuffer(recording, "<f4", 3 * len(LANDMARKS), size + 8 * num_frames)
    samples, rate_hz = soundfile.read(DEMO / "hello-female.wav", dtype="int16")
    sound = np.tile(samples, 3)
    time_s = np.arange(0, len(sound) / rate_hz - 0.1, 0.04)
    starts = (time_s * rate_hz).astype(int)
    loudness = np.sqrt([np.square(sound[at : at + 1600].astype(float)).mean() for at in starts])
    landmarks = np.tile(points.reshape(-1, 3), (len(time_s), 1, 1))
    lower = [LANDMARKS.index(point) for point in (14, 17, 152, 178, 181, 402, 405)]
    landmarks[:, lower, 1] += 8 * (loudness / loudness.max())[:, None]  # pixels
    frames = landmarks.astype(np.float32)
    return landmark_file(time_s, frames, sound, sample_rate_hz=rate_hz)


def test_the_page_learns_keeps_uses_and_forgets_a_mouth(
    control: FakeControl, browser: Browser
) -> None:
    slow_down_tracker(browser)
    browser.evaluate(
        "window.realFetch = fetch; window.fetch = (url, options) => realFetch(url,"
        " { ...options, body: (window.recording = window.longer ?? options.body) });"
    )
    read_aloud(browser)
    assert re.search(REFUSAL, text_of(browser, "learn-problem"))
    images = browser.evaluate("images")
    later = images[images.index(["learning", 320]) :]
    assert later == [["learning", 320]] * len(later)
    assert len(later) > 1
    browser.evaluate(
        "window.send = fetch; window.fetch = async () => { throw new Error('offline') }"
    )
    browser.click("learn-resend")
    browser.wait_for("document.getElementById('learn-problem').innerText.includes('not answer')")
    browser.evaluate("fetch = send")  # the recording is kept

    recording = browser.evaluate(
        "recording.bytes().then((bytes) =>"
        " Array.from(bytes, (byte) => String.fromCharCode(byte)).join(''))"
    )
    content = base64.b64encode(lengthen(recording.encode("latin-1"))).decode()
    browser.evaluate(f"window.longer = Uint8Array.from(atob('{content}'), (c) => c.charCodeAt(0))")
    browser.click("learn-resend")
    browser.wait_for("window.kouxing.state.lesson === 'result'", 180)
    assert "more closely" in text_of(browser, "learn-verdict")
    assert "Opening" in text_of(browser, "learn-figures")
    for curve in ("tracked", "before", "after"):
        path = f"document.getElementById('learn-{curve}')"
        assert browser.evaluate(f"{path}.getTotalLength()") > 100, curve

    assert browser.evaluate("window.kouxing.state.mouthProfile") == ""
    browser.click("learn-keep")
    browser.open(browser.evaluate("location.href"))
    browser.wait_for("window.kouxing.state.mouthProfile !== ''")
    profile = base64.b64decode(browser.evaluate("window.kouxing.state.mouthProfile"))
    browser.click("microphone")
    browser.wait_for("window.kouxing.state.microphone")
    ((session, opening),) = control.openings.items()
    assert opening.mouth_profile == profile
    wait_until(lambda: control.messages_of(SetFace))
    assert [(change.session, change.face) for change in control.messages_of(SetFace)] == [
        (session, FaceSettings(lip_model="learned"))
    ]
    browser.click("microphone")
    browser.wait_for("!window.kouxing.state.microphone")

    browser.click("learn")
    assert "opening" in text_of(browser, "learn-profile")
    browser.click("learn-forget")
    assert browser.evaluate("window.kouxing.state.mouthProfile + localStorage.length") == "0"
    wrong = [text for text in browser.page_errors if '"error"' in text or "exception" in text]
    assert ["learn-mouth" in text for text in wrong] == [True]  # the refusal


def test_a_slow_computer_is_reported_before_reading(browser: Browser) -> None:
    set_min_rate(browser, 1000)
    browser.evaluate("window.kouxing.readingS = 600")
    start_recording(browser)
    browser.wait_for("window.kouxing.state.lesson === 'problem'")
    assert "too slow to track your face" in text_of(browser, "learn-problem")
    browser.click("learn-mouth [data-step=problem] .close")


def test_a_slow_start_is_explained_from_the_first_moment(browser: Browser) -> None:
    browser.evaluate("void (document.body.append = () => {})")  # the tracker never loads
    start_recording(browser)
    assert "On a slow computer" in text_of(browser, "learn-advice")
    browser.click("learn-mouth [data-step=reading] .close")
    browser.evaluate("delete document.body.append")


def test_the_page_records_the_same_landmarks(browser: Browser) -> None:
    kept = browser.evaluate("(async () => (await import('/face-recording.js')).LANDMARKS)()")
    assert tuple(kept) == LANDMARKS


def test_the_page_reports_a_missing_camera(browser: Browser) -> None:
    browser.evaluate(
        "navigator.mediaDevices.getUserMedia ="
        " () => Promise.reject(new DOMException('none', 'NotFoundError'))"
    )
    start_recording(browser)
    browser.wait_for("window.kouxing.state.lesson === 'problem'")
    assert "No camera" in text_of(browser, "learn-problem")
    browser.evaluate("document.getElementById('learn-mouth').close()")


def test_the_page_explains_that_cameras_need_https(browser: Browser) -> None:
    browser.evaluate("Object.defineProperty(navigator, 'mediaDevices', { value: undefined })")
    browser.click("learn")
    browser.wait_for("window.kouxing.state.lesson === 'intro'")
    assert "https" in text_of(browser, "learn-insecure")
    browser.wait_for("document.getElementById('learn-start').disabled")
