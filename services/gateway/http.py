"""HTTP: the page's files, who may ask for them, and the WebSockets that are open."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import re
from collections.abc import AsyncIterator, Collection
from pathlib import Path

from aiohttp import WSCloseCode, web
from aiohttp.typedefs import Handler

import kouxing.shared.face
from kouxing.services.gateway.access import Access
from kouxing.services.gateway.places import Places
from kouxing.shared.logs import LOG

PAGE = Path(__file__).parent / "page"
LIGHT = Path(kouxing.shared.face.__file__).with_name(
    "light.glsl"
)  # the page and the driver share it
THREE = PAGE / "node_modules" / "three"
FACE_MESH = PAGE / "node_modules" / "@mediapipe" / "face_mesh"
# The files that are served: of the page, and of the module that finds a face in a picture.
SUFFIXES = {
    PAGE: {".html", ".js", ".css", ".svg", ".glb", ".webp"},
    FACE_MESH: {".js", ".wasm", ".data", ".binarypb"},
}
PING_S = 20.0  # a browser that has vanished is noticed within this
MAX_MESSAGE_BYTES = 128 * 1024  # the most that one message of a session may carry
MAX_UPLOAD_BYTES = 8 * 1024 * 1024
FACE_MESH_FRAME = "face-mesh.html"
_HEADERS = {  # of every answer
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}
# WebAssembly's own glue makes functions from text, so it runs in a frame of its own, which is
# allowed that and is denied the camera and the microphone.
_FACE_MESH_POLICIES = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self' 'unsafe-eval'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    ),
    "Permissions-Policy": "camera=(), microphone=()",
}
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


class WebSockets:
    """The WebSockets that browsers have open."""

    def __init__(self) -> None:
        self._open: set[web.WebSocketResponse] = set()
        self._is_closing = False

    def __len__(self) -> int:
        return len(self._open)

    @contextlib.asynccontextmanager
    async def accept(
        self, request: web.Request, places: Places
    ) -> AsyncIterator[web.WebSocketResponse]:
        """Open a WebSocket, if there is a place for it, and close it in the end."""
        if self._is_closing:
            raise web.HTTPServiceUnavailable(text="the gateway stops\n")
        with places.held(request):
            browser = web.WebSocketResponse(
                heartbeat=PING_S, max_msg_size=MAX_MESSAGE_BYTES, timeout=1.0, compress=False
            )
            await browser.prepare(request)
            self._open.add(browser)
            try:
                yield browser
            finally:
                self._open.discard(browser)
                await browser.close()

    async def close_all(self) -> None:
        """Close every WebSocket, and accept no more."""
        self._is_closing = True
        closing = [
            browser.close(code=WSCloseCode.GOING_AWAY, message=b"the gateway stops")
            for browser in self._open
        ]
        await asyncio.gather(*closing, return_exceptions=True)


def make_application(
    *,
    page_asset: str,
    routes: Collection[web.RouteDef],
    access: Access = Access(),  # noqa: B008 - it is frozen
    frame_ancestors: str = "",
) -> web.Application:
    """Return the web application.

    Parameters
    ----------
    page_asset
        Another GLB to serve as the page's head; empty: the one beside the page.
    routes
        Further paths: sessions and uploads.
    access
        What requests must show.
    frame_ancestors
        Origins of pages that may show the page in a frame, separated by spaces.
    """
    application = web.Application(
        middlewares=[access.guard({route.path for route in routes})],
        client_max_size=MAX_UPLOAD_BYTES,
    )
    application.on_response_prepare.append(add_headers)

    async def serve_page(request: web.Request) -> web.StreamResponse:
        return _page_file(request.match_info.get("name", "index.html"), page_asset, frame_ancestors)

    async def serve_face_mesh(request: web.Request) -> web.StreamResponse:
        return web.FileResponse(_find(FACE_MESH, request.match_info["name"]))

    application.add_routes(routes)
    application.router.add_get("/", serve_page)
    application.router.add_get("/{name}", serve_page)
    application.router.add_get("/modules/face_mesh/{name}", serve_face_mesh)
    if _has_modules():
        for folder in ("build", "examples/jsm"):
            application.router.add_static(f"/modules/three/{folder}", THREE / folder)
    else:
        LOG.warning("the page's modules are missing; run 'npm ci' in %s", PAGE)
    return application


def make_socket_application(serve: Handler, access: Access) -> web.Application:
    """Return an application that is nothing but one WebSocket, under no path."""
    application = web.Application(middlewares=[access.guard({"/"})])
    application.router.add_get("/", serve)
    return application


async def add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    """Forbid browsers what no answer of this server needs."""
    response.headers.update(_HEADERS)


def _has_modules() -> bool:
    return THREE.is_dir() and FACE_MESH.is_dir()


def _find(folder: Path, name: str) -> Path:
    """Return a file that is served."""
    path = folder / name
    if path.parent != folder or path.suffix not in SUFFIXES[folder] or not path.is_file():
        raise web.HTTPNotFound
    return path


def _page_file(name: str, page_asset: str, frame_ancestors: str) -> web.StreamResponse:
    if name in ("head.glb", "head-woman.glb"):
        is_own = name == "head.glb" and page_asset
        path = Path(page_asset) if is_own else PAGE / "head.glb"
        if not path.is_file():
            text = f"the head is missing; make it with 'kouxing head export {path}'\n"
            raise web.HTTPNotFound(text=text)
    else:
        path = LIGHT if name == LIGHT.name else _find(PAGE, name)
    if not _has_modules():
        text = "the page's modules are missing; run 'npm ci' in services/gateway/page\n"
        raise web.HTTPServiceUnavailable(text=text)
    response = web.FileResponse(path)
    if name == "index.html":
        response.headers["Content-Security-Policy"] = _content_policy(path, frame_ancestors)
    elif name == FACE_MESH_FRAME:
        response.headers.update(_FACE_MESH_POLICIES)
    return response


def _content_policy(index: Path, frame_ancestors: str) -> str:
    """Return the policy that lets the page load nothing but its own files.

    The import map has to stand in the page itself, so it is allowed by its digest.
    """
    found = _IMPORT_MAP.search(index.read_text(encoding="utf-8"))
    allowed = frame_ancestors or "'none'"
    digest = hashlib.sha256(found[1].encode() if found else b"").digest()
    import_map = f"'sha256-{base64.b64encode(digest).decode()}'"
    return (
        f"default-src 'self'; script-src 'self' {import_map}; img-src 'self' blob: data:; "
        "connect-src 'self' blob:; object-src 'none'; base-uri 'none'; "
        f"frame-ancestors {allowed}"
    )
