"""The page in a real browser: frames become pixels, sound is played, a microphone becomes PCM.

The gateway is real. Control, recognizer and synthesizer play a script, so that the correct image is
known. The Chrome DevTools Protocol drives the browser.
"""

import socket

import numpy as np
import pytest
from kouxing_client import Session
from numpy.typing import NDArray

from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import OpenSession
from tests.browser import SIZE_PX, Browser
from tests.e2e.page_actions import A_FACE, B_FACE, NOTICE, STATE, choose, colorfulness, is_loud
from tests.e2e.page_control import LOOK_AHEAD_MS, PageControl
from tests.system import Gateway, wait_until

IS_BEHIND = "document.getElementById('status').dataset.state === 'behind'"
IS_BACK = f"!{STATE}.microphone && {STATE}.session === 'seen'"  # the microphone is off


@pytest.fixture
def talking_page(control: PageControl, session: Session, page: Browser) -> Browser:
    """The page with a talking face and its sound."""
    control.talk(session.name, A_FACE, "a")
    page.wait_for(f"{STATE}.faps[2] > 440")  # the face does not wait for a click
    if page.evaluate(f"{STATE}.sound") != "on":
        page.wait_for(f"{STATE}.sound === 'blocked'")
        assert "Turn on sound" in page.evaluate("document.getElementById('sound').textContent")
        page.click("sound")
    page.wait_for(f"{STATE}.sound === 'on'")
    return page


def turn_on_microphone(control: PageControl, page: Browser) -> str:
    """Return the name of the microphone's session."""
    before = {*control.openings}
    page.click("microphone")
    page.wait_for(f"{STATE}.microphone")
    (name,) = {*control.openings} - before
    return name


def turn_off_microphone(page: Browser) -> None:
    page.click("microphone")
    page.wait_for(IS_BACK)


def show_controls(page: Browser, share: int) -> None:
    page.evaluate(
        "for (const part of document.querySelectorAll('header, footer, #behind'))"
        f" part.style.opacity = {share}"
    )


def teeth(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels that are bright and gray, unlike skin and lips."""
    is_tooth: NDArray[np.bool_] = (colorfulness(image) < 35) & (image.mean(axis=2) > 100)
    return is_tooth


def test_the_mouth_in_the_image_follows_the_faps(
    control: PageControl, session: Session, page: Browser
) -> None:
    control.talk(session.name, B_FACE, "b")
    page.keep_resolution()
    show_controls(page, 0)
    show = f"Math.abs({STATE}.faps[2] - {{}}) < 1 && {STATE}.caption === '{{}}'"

    page.wait_for(show.format(0, "b"))
    closed = page.steady_image()
    control.talk(session.name, A_FACE, "a")
    page.wait_for(show.format(450, "a"))
    opened = page.steady_image()
    control.talk(session.name, B_FACE, "b")
    page.wait_for(show.format(0, "b"))
    closed_again = page.steady_image()
    show_controls(page, 1)

    rows, columns = np.nonzero(teeth(opened) & (colorfulness(closed) > 50))
    (top, bottom), (left, right) = (
        np.percentile(at, (15, 85)).astype(int) for at in (rows, columns)
    )
    mouth = slice(top, bottom + 1), slice(left, right + 1)
    assert (left + right) / 2 == pytest.approx(SIZE_PX[0] / 2, abs=8)
    assert 0 < bottom - top < right - left < SIZE_PX[0] / 5
    assert teeth(opened)[mouth].mean() > 0.25
    assert teeth(closed)[mouth].mean() < 0.02
    assert teeth(closed_again)[mouth].mean() < 0.02
    wrong = ('"level": "error"', "exceptionDetails")
    assert not [text for text in page.page_errors if any(mark in text for mark in wrong)]


@pytest.mark.parametrize(
    ("size", "covers", "edge"), [((320, 568), "caption", "top"), ((667, 375), "settings", "left")]
)
def test_controls_do_not_cover_the_mouth_on_a_phone(
    control: PageControl,
    session: Session,
    page: Browser,
    size: tuple[int, int],
    covers: str,
    edge: str,
) -> None:
    page.resize(*size, mobile=True)
    page.keep_resolution()
    if covers == "settings":
        page.click("open-settings")
        page.evaluate("document.getElementById('settings').style.opacity = 0")
    show_controls(page, 0)
    images = []
    for shown, jaw in ((B_FACE, 0), (A_FACE, 450)):
        control.talk(session.name, shown, "a")
        page.wait_for(f"Math.abs({STATE}.faps[2] - {jaw}) < 1")
        images.append(page.steady_image())
    closed, opened = images
    show_controls(page, 1)
    limit = page.evaluate(f"document.getElementById('{covers}').getBoundingClientRect().{edge}")
    rows, columns = np.nonzero(teeth(opened) & (colorfulness(closed) > 50))
    page.evaluate("document.getElementById('settings').removeAttribute('style')")
    page.evaluate("document.getElementById('settings').hidePopover()")
    page.resize(*SIZE_PX)
    assert len(rows) > 20
    assert np.percentile(rows if edge == "top" else columns, 90) < limit


@pytest.mark.usefixtures("infrequent_drawing")
@pytest.mark.parametrize(("width", "is_phone"), [(1280, False), (390, True)])
def test_every_control_can_be_clicked(page: Browser, width: int, is_phone: bool) -> None:
    page.resize(width, 844, mobile=is_phone)
    shown = (
        "[...document.querySelectorAll('{} :is(button, select, input)')].filter((item) =>"
        "item.checkVisibility()).map((item, index) => (item.id ||= `control-${{index}}`))"
    )
    in_footer = page.evaluate(shown.format("footer"))
    assert "open-settings" in in_footer
    for name in in_footer:
        page.center_of(name)
    page.click("open-settings")
    in_settings = page.evaluate(shown.format("#settings"))
    assert len(in_settings) > 5
    for name in in_settings:
        page.center_of(name)
    page.evaluate("document.getElementById('settings').hidePopover()")
    page.resize(*SIZE_PX)


@pytest.mark.usefixtures("infrequent_drawing")
@pytest.mark.parametrize("size", [(375, 667), (667, 375)])
def test_panels_on_a_phone_have_buttons_without_scrolling(
    page: Browser, size: tuple[int, int]
) -> None:
    page.resize(*size, mobile=True)
    page.click("open-settings")
    page.click("close-settings")
    page.wait_for("!document.querySelector(':popover-open')")
    page.click("learn")
    page.evaluate(  # the longest step, without a camera
        "for (const part of document.querySelectorAll('dialog section'))"
        " part.hidden = part.dataset.step !== 'reading';"
        "document.getElementById('learn-reading').textContent = 'A long text. '.repeat(60);"
    )
    assert page.evaluate(
        "document.querySelector('[data-step=reading] .close').getBoundingClientRect().bottom"
        " <= document.getElementById('learn-mouth').getBoundingClientRect().bottom"
    )
    page.evaluate("document.getElementById('learn-mouth').close()")
    page.resize(*SIZE_PX)


@pytest.mark.usefixtures("infrequent_drawing")
def test_the_caption_shows_syllables_or_phones(
    control: PageControl, session: Session, page: Browser
) -> None:
    control.talk(session.name, A_FACE, "iao")
    for caption in ("yao", "iao"):
        page.wait_for(f"window.kouxing?.state.caption === '{caption}'")
        page.click("show-phones")
    for is_shown in (False, True):
        page.evaluate("document.getElementById('captions').click()")
        assert page.evaluate("document.getElementById('spoken').offsetHeight > 0") is is_shown


def test_sound_starts_with_a_click_and_waits_for_its_image(talking_page: Browser) -> None:
    played = talking_page.evaluate(f"{STATE}.soundSamplesPlayed")
    talking_page.wait_for(f"{STATE}.soundSamplesPlayed > {played + 16000}")
    text = "document.getElementById('delay').textContent"
    talking_page.wait_for(f"{text}.startsWith('sound delay') || {IS_BEHIND}")  # a busy machine
    talking_page.wait_for(f"{STATE}.playoutDelayMs > {LOOK_AHEAD_MS - 20}")


def test_senders_are_started_delayed_to_match_the_sound_and_stopped(talking_page: Browser) -> None:
    page = talking_page
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        url = f"osc://127.0.0.1:{program.getsockname()[1]}"
        page.click("open-settings")
        page.evaluate(f"document.getElementById('send-to').value = {url!r}")
        page.click("send button")
        # a busy page may hide the button again, so click as soon as it is shown
        button = "document.getElementById('send-delay')"
        page.wait_for(f"!{button}.hidden && ({button}.click(), true)")
        page.wait_for("/delayed \\d+ ms/.test(document.getElementById('senders').innerText)")
        page.click("senders button")
        page.wait_for("document.getElementById('senders').children.length === 0")
    page.evaluate("document.getElementById('send-to').value = 'vmc://192.0.2.1'")
    page.click("send button")
    page.wait_for("document.getElementById('send-problem').innerText.includes('another machine')")
    page.evaluate("document.getElementById('settings').hidePopover()")


def test_sound_waits_for_frames_while_the_page_is_hidden(
    control: PageControl, talking_page: Browser
) -> None:
    page = talking_page
    page.wait_for(f"{STATE}.soundMinusImageMs !== null")
    before_ms = page.evaluate(f"{STATE}.playoutDelayMs")  # a busy page waits for longer
    page.evaluate(
        "window.ticks = []; window.tick = requestAnimationFrame;"
        "window.requestAnimationFrame = (act) => window.ticks.push(act)"
    )
    try:
        control.look_ahead_ms = round(before_ms) + 100
        page.wait_for(f"{STATE}.playoutDelayMs > {before_ms + 100}")  # nothing was drawn
    finally:  # the next tests use the same page
        control.look_ahead_ms = LOOK_AHEAD_MS
        page.evaluate("window.requestAnimationFrame = window.tick; window.ticks.forEach(tick)")


def test_reports_a_face_that_is_behind_and_draws_fewer_pictures(
    control: PageControl, talking_page: Browser
) -> None:
    page = talking_page
    control.look_ahead_ms = LOOK_AHEAD_MS + 2010
    status = "document.getElementById('status').textContent"
    page.wait_for(f"/behind: this computer is busy +\\d\\.\\d s/.test({status})")
    page.evaluate("document.getElementById('lower-frame-rate').click()")
    page.wait_for("!document.getElementById('restore-frame-rate').hidden")
    page.evaluate("document.getElementById('restore-frame-rate').click()")
    page.wait_for("document.getElementById('restore-frame-rate').hidden")
    control.look_ahead_ms = LOOK_AHEAD_MS


@pytest.mark.usefixtures("infrequent_drawing")
def test_the_microphone_reaches_the_recognizer(
    control: PageControl, session: Session, page: Browser
) -> None:
    control.shown = None
    name = turn_on_microphone(control, page)
    wait_until(lambda: len(control.samples(name)) > 48000)
    page.wait_for(f"{STATE}.session === '{name}'")
    assert page.evaluate(f"{STATE}.sound") == "off"  # the user's own voice is not played
    turn_off_microphone(page)
    wait_until(lambda: control.has_ended(name))
    opening = control.openings[name]
    assert (opening.num_channels, opening.encoding) == (1, "s16le")
    assert opening.sample_rate_hz in (44100, 48000)
    assert is_loud(control.samples(name))


@pytest.mark.usefixtures("infrequent_drawing")
def test_a_microphone_can_be_turned_off_while_it_starts(
    control: PageControl, session: Session, page: Browser
) -> None:
    page.page_errors.clear()
    page.evaluate("for (let i = 0; i < 2; i++) document.getElementById('microphone').click()")
    name = turn_on_microphone(control, page)
    turn_off_microphone(page)
    wait_until(lambda: control.has_ended(name))
    assert not [text for text in page.page_errors if "exceptionDetails" in text]


@pytest.mark.usefixtures("infrequent_drawing")
def test_after_the_microphone_the_session_of_the_address_is_shown(
    control: PageControl, session: Session, gateway: Gateway, page: Browser
) -> None:
    control.start("newest")
    page.open(f"{gateway.page}?session={session.name}")
    turn_on_microphone(control, page)
    page.wait_for(f"!['newest', 'seen', null].includes({STATE}.session)")
    turn_off_microphone(page)
    control.stop_session("newest")
    page.open(gateway.page)


def face_changes(control: PageControl) -> list[tuple[str, FaceSettings]]:
    return [(message.session, message.face) for message in control.messages_of(SetFace)]


def slider_amounts(control: PageControl) -> list[tuple[str, float]]:
    return [
        (name, face.expressiveness) for name, face in face_changes(control) if face.expressiveness
    ]


@pytest.mark.usefixtures("infrequent_drawing")
def test_settings_apply_at_once_and_to_later_sessions(
    control: PageControl, session: Session, page: Browser, gateway: Gateway
) -> None:
    control.received.clear()
    first = turn_on_microphone(control, page)
    page.wait_for(f"{STATE}.lipModel === 'dynamic-visemes'")
    page.wait_for("document.getElementById('expressiveness-shown').value === '100 %'")
    control.send(SetFace(session=first, face=FaceSettings(expressiveness=1.2)))  # another viewer's
    page.wait_for("document.getElementById('expressiveness-shown').value === '120 %'")
    choose(page, "lips", "ferguson")
    page.wait_for(f"{STATE}.lipModel === 'ferguson'")
    assert control.messages_of(OpenSession)[-1].language == "zh"
    choose(page, "expressiveness", 0.7)
    wait_until(lambda: len(slider_amounts(control)) == 1)
    page.click("open-settings")
    page.click("expressions [value=surprise]")
    wait_until(lambda: face_changes(control)[-1][1].expressions == {"surprise": 0.8})
    page.evaluate("document.getElementById('settings').hidePopover()")
    turn_off_microphone(page)

    page.open(gateway.page)
    assert page.evaluate("document.getElementById('lips').value") == "ferguson"
    second = turn_on_microphone(control, page)
    page.wait_for(f"{STATE}.lipModel === 'ferguson'")
    wait_until(lambda: len(slider_amounts(control)) == 2)
    choose(page, "lips", "learned")
    page.wait_for(f"{STATE}.lipModel === 'learned'")
    turn_off_microphone(page)
    assert [(name, face.lip_model) for name, face in face_changes(control) if face.lip_model] == [
        (first, "ferguson"),
        (second, "ferguson"),
        (second, "learned"),
    ]
    assert slider_amounts(control) == [(first, 0.7), (second, 0.7)]


def test_another_head_is_shown(control: PageControl, session: Session, page: Browser) -> None:
    control.talk(session.name, B_FACE, "b")  # an idle face would move
    page.wait_for("window.kouxing.state.faps[15] > 49")
    page.keep_resolution()
    show_controls(page, 0)
    woman = page.steady_image()
    choose(page, "heads", "man")
    page.wait_for("document.getElementById('loading').hidden")
    man = page.steady_image()
    choose(page, "heads", "woman")
    page.wait_for("document.getElementById('loading').hidden")
    woman_again = page.steady_image()
    show_controls(page, 1)
    assert_changed_and_back(woman, man, woman_again)


@pytest.mark.usefixtures("infrequent_drawing")
def test_a_head_that_is_no_longer_chosen_is_not_loaded(page: Browser) -> None:
    loaded = "performance.getEntriesByType('resource').map(({ name }) => name.split('/').pop())"
    page.evaluate("performance.clearResourceTimings()")
    for name in ("man", "woman", "man"):
        choose(page, "heads", name)
    page.wait_for(f"{loaded}.filter((name) => name === 'head-man.glb').length > 0")
    page.wait_for("document.getElementById('loading').hidden")
    assert "head-woman.glb" not in page.evaluate(loaded)


@pytest.mark.usefixtures("infrequent_drawing")
def test_a_head_that_cannot_be_loaded_leaves_the_other_one_visible(page: Browser) -> None:
    page.evaluate(
        "window.realFetch = fetch; void (window.fetch = () => Promise.reject(Error('off')))"
    )
    choose(page, "heads", "woman")
    page.wait_for(f"{NOTICE}.includes('off. Check the network')")
    assert page.evaluate("document.getElementById('no-head').textContent") == ""
    page.evaluate("void (window.fetch = window.realFetch)")
    choose(page, "heads", "")
    page.wait_for("document.getElementById('loading').hidden")


def assert_changed_and_back(first: NDArray[np.uint8], *others: NDArray[np.uint8]) -> None:
    change, change_back = (
        (np.abs(first.astype(int) - other).max(axis=2) > 40).mean() for other in others
    )
    assert change > 0.02
    assert change_back < change / 4


def test_arrow_keys_turn_the_head_and_announce_it(
    control: PageControl, session: Session, page: Browser
) -> None:
    control.talk(session.name, B_FACE, "b")  # an idle face would move
    page.wait_for("window.kouxing.state.faps[15] > 49")
    page.keep_resolution()
    show_controls(page, 0)
    page.evaluate("document.getElementById('head').focus({ focusVisible: false })")
    front = page.steady_image()
    announced = "document.getElementById('turned').textContent"
    for key in ("ArrowLeft", "ArrowLeft"):
        page.command("Input.dispatchKeyEvent", type="keyDown", key=key)
    page.wait_for(f"{announced} === 'turned 20° to the left'")
    turned = page.steady_image()
    page.command("Input.dispatchKeyEvent", type="keyDown", key="Home")
    page.wait_for(f"{announced} === 'from the front'")
    front_again = page.steady_image()
    show_controls(page, 1)
    assert_changed_and_back(front, turned, front_again)


@pytest.mark.parametrize("view", ["", "?view=bare&background=transparent"])
def test_reports_a_browser_without_webgl(browser: Browser, gateway: Gateway, view: str) -> None:
    blind = "HTMLCanvasElement.prototype.getContext = () => null"
    browser.command("Page.enable")
    script = browser.command("Page.addScriptToEvaluateOnNewDocument", source=blind)
    browser.command("Page.navigate", url=gateway.page + view)
    browser.wait_for("document.getElementById('no-head')?.innerText.includes('WebGL')")
    assert "WebGL" in browser.evaluate("document.getElementById('notice').textContent")
    browser.command("Page.removeScriptToEvaluateOnNewDocument", **script)
    browser.command("Page.disable")


@pytest.mark.usefixtures("infrequent_drawing")
def test_reports_missing_services(control: PageControl, page: Browser, gateway: Gateway) -> None:
    page.open(gateway.page)
    page.wait_for(f"{NOTICE} === ''")
    control.shown, control.running, control.refuse = None, ["synthesizer"], True
    page.wait_for(f"{NOTICE}.includes('Not running: recognizer')")
    page.evaluate(  # the test ends the 8 s in which an error is shown
        "window.late = []; window.realTimeout = setTimeout; window.setTimeout ="
        " (act, ms) => (ms >= 8000 ? (late.push(act), -1) : realTimeout(act, ms)); 1"
    )
    page.click("microphone")
    page.wait_for(f"{NOTICE}.includes('start one')")
    page.wait_for(f"!{STATE}.microphone")
    choose(page, "language", "zh")
    page.wait_for("document.getElementById('microphone').ariaBusy === 'false'")
    page.click("microphone")
    page.wait_for(f"{NOTICE}.includes('缺少服务')")  # also the error of a service
    page.evaluate("window.setTimeout = realTimeout; late.forEach((act) => act())")
    page.wait_for(f"{NOTICE}.includes('没有运行')")
    choose(page, "language", "en")


@pytest.mark.usefixtures("infrequent_drawing")
def test_reconnects_when_the_gateway_restarts(
    control: PageControl, gateway: Gateway, page: Browser
) -> None:
    assert gateway.stop() == 0
    page.wait_for(f"{NOTICE}.includes('The gateway does not answer')")
    assert "disconnected" in page.evaluate("document.getElementById('status').textContent")
    gateway.start()
    page.wait_for(f"{STATE}.connected")
