"""The web application: the page's files, its security policy, and open WebSockets."""

import asyncio
import base64
import contextlib
import hashlib
import re
from collections.abc import AsyncIterator, Collection
from pathlib import Path

from aiohttp import WSCloseCode, WSMsgType, web

import kouxing.shared.face
from kouxing.services.gateway.web.access import AccessPolicy
from kouxing.services.gateway.web.limits import ConnectionQuota
from kouxing.services.heads import HEAD_NAMES, page_file, page_heads_folder
from kouxing.services.lip_models import lip_models
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.phones.inventory import language_titles

PAGE_FOLDER = Path(__file__).parents[1] / "page"
LIGHT_SHADER = Path(kouxing.shared.face.__file__).with_name("light.glsl")  # shared with the driver
PING_S = 20.0  # interval of pings that detect vanished browsers
MAX_MESSAGE_BYTES = 128 * 1024  # limit for a WebSocket message without audio
CHUNK_BYTES = 32 * 1024  # read from a file at once; a client that does not read holds two
DISCARD_S = 5.0
LINGER_S = 1.0  # after an invalid message, data is read and discarded for this time
MAX_REASON_BYTES = 123  # limit for the reason in a close frame, RFC 6455
MAX_BODY_BYTES = 128 * 1024  # handlers of uploads set other limits
FACE_MESH_FRAME = "face-mesh.html"
_CLOSE_REASONS: dict[int, str] = {  # when aiohttp closes the connection
    WSCloseCode.OK: "the connection has ended",
    WSCloseCode.PROTOCOL_ERROR: "the data is not a valid WebSocket message",
    WSCloseCode.INVALID_TEXT: "a text message is not valid UTF-8",
    WSCloseCode.MESSAGE_TOO_BIG: "a message is larger than {}; send it in smaller messages",
}
_PAGE_SUFFIXES = {".html", ".js", ".css", ".svg", ".glb", ".webp"}
_FACE_MESH_SUFFIXES = {".js", ".wasm", ".data", ".binarypb"}
# The face mesh's WebAssembly glue code compiles text into functions. It runs in a frame that
# permits this but has no access to camera or microphone.
_FACE_MESH_POLICIES = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'unsafe-eval'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    ),
    "Permissions-Policy": "camera=(), microphone=()",
}
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)
_NO_MODULES = f"the page's JavaScript modules are missing; run 'npm ci' in {PAGE_FOLDER}"


class _WebSocket(web.WebSocketResponse):
    """A WebSocket that gives a reason whenever it closes."""

    def __init__(self, max_message_bytes: int, ping_s: float | None) -> None:
        # aiohttp also rejects messages of exactly this size
        super().__init__(
            heartbeat=ping_s,
            max_msg_size=max_message_bytes + 1,
            timeout=1.0,
            compress=False,
            writer_limit=0,  # each message waits until the transport can take it
        )
        self._max_size = f"{max_message_bytes >> 10} KiB"

    async def close(
        self, *, code: int = WSCloseCode.OK, message: bytes = b"", drain: bool = True
    ) -> bool:
        reason = message or _CLOSE_REASONS.get(code, "").format(self._max_size).encode()
        # cut without an incomplete character
        reason = reason[:MAX_REASON_BYTES].decode(errors="ignore").encode()
        if code in _CLOSE_REASONS and code != WSCloseCode.OK and not self.closed:
            # The client may still send. It would lose the reason if the connection closed now.
            with contextlib.suppress(ConnectionError):
                await self.send_frame(code.to_bytes(2, "big") + reason, WSMsgType.CLOSE)
                await asyncio.sleep(LINGER_S)
        return await super().close(code=code, message=reason, drain=drain)


class OpenWebSockets:
    """Tracks the browsers' open WebSockets."""

    def __init__(self) -> None:
        self._open: set[web.WebSocketResponse] = set()
        self._is_closing = False

    def __len__(self) -> int:
        return len(self._open)

    @contextlib.asynccontextmanager
    async def open(
        self,
        request: web.Request,
        quota: ConnectionQuota,
        *,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        ping_s: float | None = PING_S,
    ) -> AsyncIterator[web.WebSocketResponse]:
        """Answer a request with a WebSocket that stays open while the context is open.

        Raises ``web.HTTPServiceUnavailable`` if the quota is used up or the gateway is stopping.
        """
        if self._is_closing:
            raise web.HTTPServiceUnavailable(text="the gateway is stopping\n")
        with quota.hold(request):
            browser = _WebSocket(max_message_bytes, ping_s)
            await browser.prepare(request)
            self._open.add(browser)
            try:
                yield browser
            finally:
                self._open.discard(browser)
                await browser.close()

    async def close_all(self) -> None:
        """Close every WebSocket and reject new ones."""
        self._is_closing = True
        closing = [
            browser.close(code=WSCloseCode.GOING_AWAY, message=b"the gateway is stopping")
            for browser in self._open
        ]
        await asyncio.gather(*closing, return_exceptions=True)


def make_application(
    *, head: str, routes: Collection[web.RouteDef], access: AccessPolicy, frame_ancestors: str = ""
) -> web.Application:
    """Return the web application.

    ``head`` is a built-in head or a GLB file, to serve as ``head.glb``.
    ``routes`` are private: sessions and uploads. Pages of ``frame_ancestors``, origins that are
    separated by spaces, may show the page in a frame.

    Raises ``UserError`` if the page cannot show the head.
    """
    _check_head(head)
    application = web.Application(
        middlewares=[access.middleware({route.path for route in routes})],
        client_max_size=MAX_BODY_BYTES,
    )
    modules = _modules_folder()
    if modules is None:
        LOG.warning("%s", _NO_MODULES)

    async def serve_page(request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "index.html")
        response = _page_file(name, head, frame_ancestors)
        if modules is None:
            raise web.HTTPServiceUnavailable(text=f"{_NO_MODULES}\n")
        return response

    application.add_routes(routes)
    application.router.add_get("/", serve_page)
    application.router.add_get("/offers.json", _serve_offers)
    application.router.add_get("/{name}", serve_page)
    if modules is not None:
        face_mesh = modules / "@mediapipe" / "face_mesh"

        async def serve_face_mesh(request: web.Request) -> web.StreamResponse:
            file = _find(face_mesh, request.match_info["name"], _FACE_MESH_SUFFIXES)
            return web.FileResponse(file, CHUNK_BYTES)

        application.router.add_get("/modules/face_mesh/{name}", serve_face_mesh)
        for folder in ("build", "examples/jsm"):
            path = modules / "three" / folder
            prefix = f"/modules/three/{folder}"
            application.router.add_static(prefix, path, chunk_size=CHUNK_BYTES)
    return application


def _check_head(head: str) -> None:
    if head in HEAD_NAMES:
        return
    if not Path(head).is_file():
        raise UserError(f"gateway.head: {head}: no such file")
    if Path(head).suffix.lower() != ".glb":
        raise UserError(
            "gateway.head: the page needs a GLB file; run:"
            f" kouxing head export head.glb --head {head}"
        )


async def discard_body(request: web.Request) -> None:
    """Discard the rest of an upload for up to ``DISCARD_S``: browsers read the answer after it."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(DISCARD_S):
            while await request.content.readany():
                pass


def _modules_folder() -> Path | None:
    """Return the folder of the page's JavaScript modules.

    An installed package has them in ``vendor``, a source tree in ``node_modules``.
    """
    for folder in (PAGE_FOLDER / "vendor", PAGE_FOLDER / "node_modules"):
        if (folder / "three").is_dir() and (folder / "@mediapipe" / "face_mesh").is_dir():
            return folder
    return None


async def _serve_offers(_request: web.Request) -> web.StreamResponse:
    """Answer with the names of heads, and the titles of lip models and of languages."""
    heads = sorted(path.stem.removeprefix("head-") for path in PAGE_FOLDER.glob("head-*.webp"))
    models = lip_models()
    names = sorted(models, key=lambda name: name != DEFAULT_LIP_MODEL)
    lips = {name: dict(models[name].titles) for name in names}
    return web.json_response({"heads": heads, "lips": lips, "languages": language_titles()})


def _find(folder: Path, name: str, suffixes: Collection[str]) -> Path:
    """Return a file of a folder.

    Raises ``web.HTTPNotFound`` if the file does not exist or its suffix is not one of ``suffixes``.
    """
    path = folder / name
    if path.parent != folder or path.suffix not in suffixes or not path.is_file():
        raise web.HTTPNotFound
    return path


def _page_file(name: str, head: str, frame_ancestors: str) -> web.StreamResponse:
    if name == "head.glb":
        path = _page_head(page_file(head)) if head in HEAD_NAMES else Path(head)
    elif name.endswith(".glb"):
        path = _page_head("head.glb" if name == "head-woman.glb" else name)
    else:
        path = (
            LIGHT_SHADER if name == LIGHT_SHADER.name else _find(PAGE_FOLDER, name, _PAGE_SUFFIXES)
        )
    response = web.FileResponse(path, CHUNK_BYTES)
    if name == "index.html":
        response.headers["Content-Security-Policy"] = _content_policy(path, frame_ancestors)
    elif name == FACE_MESH_FRAME:
        response.headers.update(_FACE_MESH_POLICIES)
    return response


def _page_head(file: str) -> Path:
    """Return the file of a head, from the page's folder or from the cache folder."""
    with contextlib.suppress(web.HTTPNotFound):
        return _find(PAGE_FOLDER, file, {".glb"})
    try:
        folder = page_heads_folder()
    except UserError as error:
        raise web.HTTPNotFound(text=f"head {file} is missing: {error}\n") from None
    with contextlib.suppress(web.HTTPNotFound):
        return _find(folder, file, {".glb"})
    command = f"mkdir -p {folder} && kouxing head export {folder}"
    raise web.HTTPNotFound(text=f"head {file} is missing; create all heads with '{command}'\n")


def _content_policy(index: Path, frame_ancestors: str) -> str:
    """Return a policy that restricts the page to its own files.

    The import map must be inline, so the policy allows it by its digest.
    """
    match = _IMPORT_MAP.search(index.read_text(encoding="utf-8"))
    digest = hashlib.sha256(match[1].encode() if match else b"").digest()
    ancestors = frame_ancestors or "'none'"
    import_map = f"'sha256-{base64.b64encode(digest).decode()}'"
    return (
        f"default-src 'self'; script-src 'self' {import_map}; img-src 'self' blob: data:; "
        "connect-src 'self' blob:; object-src 'none'; base-uri 'none'; "
        f"frame-ancestors {ancestors}"
    )
