"""The page translates every text that the gateway sends about files, mouths and other programs."""

import ast
import re
from collections.abc import Iterator

from kouxing.shared.wire.session import ErrorCode
from tests.system import ROOT

PAGE = ROOT / "services" / "gateway" / "page"
PAGE_TEXTS = PAGE / "gateway-texts.js"
# The texts of other modules are about messages and samples that the page does not send.
SOURCES = (
    *("shared/audio/audio_file.py", "shared/audio/media_file.py", "shared/audio/audio_formats.py"),
    *("shared/audio/phase_cancellation.py", "shared/audio/wav_parts.py"),
    "shared/audio/level_check.py",
    *("services/gateway/uploads/upload_handlers.py", "services/gateway/uploads/audio_decoder.py"),
    "services/gateway/viewers/viewer_handler.py",
    *("services/gateway/senders_api.py", "services/mouth_profiles/face_landmarks.py"),
    *("services/mouth_profiles/landmark_file.py", "services/mouth_profiles/learning.py"),
    *("services/senders/connection.py", "services/senders/protocols.py"),
    *("services/senders/sender_pool.py", "services/senders/target.py"),
    *("services/senders/vtube_studio.py", "clients/python/kouxing_client/base.py"),
    *("clients/python/kouxing_client/core.py", "clients/python/kouxing_client/session_core.py"),
)
CONTROL_SOURCES = (  # their errors reach the page through control's messages
    *("services/control/session_lifecycle.py", "services/control/placement.py"),
    *("services/control/service_registry.py", "services/control/request_handler.py"),
    *("services/control/session_table.py", "services/recognizer/service.py"),
)
# Texts of the command line, of other clients than the page, and of a broken page.
OTHERS = re.compile(
    r"--rate|^this is \{\}$|--raw$|--raw if|a terminal|audio arrived|images and audio"
    r"|a folder|no such file|there is no track|expected 'start'|has disconnected"
    r"|it is larger|landmark file|header|landmarks a frame|sample rate is|times do|not pixels"
    r"|a viewer can set|without 'record'|cannot be combined|contains no command"
    r"|a worker must name|may provide|host and port to connect to|registered with another key"
)


def template(node: ast.expr) -> str:
    """Return a text with {} for values; empty if it is not a text."""
    if isinstance(node, ast.JoinedStr):
        parts = (v.value if isinstance(v, ast.Constant) else "{}" for v in node.values)
        return "".join(map(str, parts)).removeprefix("{}: ")
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def sent_texts(source: str) -> Iterator[str]:
    """Yield the texts of errors, warnings and problems in a module."""
    for node in ast.walk(ast.parse((ROOT / source).read_text("utf-8"))):
        if isinstance(node, ast.Call) and node.args:
            name = ast.unparse(node.func)
            if name.endswith(("UserError", "_error", "warnings.append", "notices.append")):
                yield template(node.args[-1])
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("problem"):
            yield template(node.value)
        if isinstance(node, ast.Return) and node.value is not None and "formats" in source:
            yield template(node.value)


def control_texts(source: str) -> Iterator[str]:
    """Yield the texts of errors in a module that sends them with an error code."""
    for node in ast.walk(ast.parse((ROOT / source).read_text("utf-8"))):
        if isinstance(node, ast.Call) and any("ErrorCode." in ast.unparse(a) for a in node.args):
            yield from map(template, node.args)
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "text":
            yield template(node.value)


def test_the_page_translates_all_texts_that_it_may_get() -> None:
    texts, _ = PAGE_TEXTS.read_text("utf-8").split("const REASONS")
    keys = re.findall(r'^  "(.+?)":(?: "|$)', texts, re.MULTILINE)
    translated = {re.sub(r"\{\w+\}", "{}", key) for key in keys}
    sent = {text for source in SOURCES for text in sent_texts(source) if " " in text}
    sent |= {text for source in CONTROL_SOURCES for text in control_texts(source) if " " in text}
    assert not {text for text in sent - translated if not OTHERS.search(text)}
    everything = "\n".join(
        template(node)
        for source in (*SOURCES, *CONTROL_SOURCES)
        for node in ast.walk(ast.parse((ROOT / source).read_text("utf-8")))
        if isinstance(node, ast.Constant | ast.JoinedStr)
    )
    unknown = {
        key for key in translated if any(part.strip() not in everything for part in key.split("{}"))
    }
    assert not unknown, "these texts no longer exist"


def test_chinese_texts_contain_the_same_values_as_english_texts() -> None:
    pairs = re.findall(r'^  "(.+?)":\s*"(.*?)",$', PAGE_TEXTS.read_text("utf-8"), re.MULTILINE)
    texts = (PAGE / "texts.js").read_text("utf-8")
    pairs += re.findall(r'en: "(.*?)",\s*zh: "(.*?)"', texts)
    assert len(pairs) > 200
    different = [
        english
        for english, chinese in pairs
        if {*re.findall(r"\{\w+\}", english)} != {*re.findall(r"\{\w+\}", chinese)}
    ]
    assert not different


def test_the_page_has_a_text_for_each_error_of_control() -> None:
    _, reasons = PAGE_TEXTS.read_text("utf-8").split("const REASONS")
    assert {*re.findall(r'^  "?([\w-]+)"?: "', reasons, re.MULTILINE)} == {*ErrorCode}
