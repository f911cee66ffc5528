"""The page has a text for each code of an error that the gateway sends."""

import ast
import re

from kouxing.shared.wire.session import ErrorCode
from tests.system import ROOT

PAGE = ROOT / "services" / "gateway" / "page"
SOURCES = [
    *PAGE.parent.glob("*.py"),
    *(ROOT / "services" / "senders").glob("*.py"),
    *(ROOT / "shared" / name for name in ("audio_file.py", "media_file.py")),
]
ERRORS = ("UserError", "AccessDenied", "Problem", "error_response")


def sent_codes() -> set[str]:
    """Return the second arguments of errors, and what is assigned to codes."""
    codes = {"file"}  # remarks on a file
    for source in SOURCES:
        for node in ast.walk(ast.parse(source.read_text("utf-8"))):
            parts: list[ast.expr] = []
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(ERRORS):
                parts = node.args[1:2]
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("code"):
                parts = [getattr(node.value, "body", node.value)]
            codes |= {str(part.value) for part in parts if isinstance(part, ast.Constant)}
    return codes - {""}


def test_the_page_has_a_text_for_each_error_code() -> None:
    texts = (PAGE / "texts.js").read_text("utf-8")
    codes = {*re.findall(r'^  "error\.(.+?)": \{', texts, re.MULTILINE)}
    assert codes == {*ErrorCode} | sent_codes()
