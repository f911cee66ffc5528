"""Who may ask the gateway for what: host names, pages of other origins, and the token."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection
from dataclasses import dataclass
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from kouxing.shared.endpoints import is_loopback

_PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, POST, DELETE",
    "Access-Control-Allow-Headers": "Authorization, Content-Type",
}
_READABLE = {"Access-Control-Expose-Headers": "Location"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """What a request must show."""

    is_own_host: Callable[[str], bool] = is_loopback
    """Tells whether a host name or address, as a browser shows it, is the gateway's own."""
    token: str = ""
    """Secret that sessions and uploads need in their query; empty: none."""
    allowed_origins: Collection[str] = ()
    """Origins of other pages that may connect."""

    def guard(self, private: Collection[str]) -> Middleware:
        """Return what refuses requests; paths of ``private`` also need origin and token.

        Pages of other origins that may connect can read the answers (CORS).
        """

        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            self._check_host(request)
            if request.method == "OPTIONS":  # what browsers ask first for a page of another origin
                self._check_origin(request)
                return web.Response(status=204, headers={**_PREFLIGHT, **self._cors(request)})
            resource = request.match_info.route.resource
            pattern = resource.canonical if resource is not None else ""
            if request.path not in private and pattern not in private:
                return await handler(request)
            self._check_origin(request)
            self._check_token(request)
            response = await handler(request)
            if not response.prepared:
                response.headers.update(self._cors(request))
            return response

        return guard

    def _check_host(self, request: web.Request) -> None:
        # A page of a strange host that resolves to this machine (DNS rebinding) shows its own name
        # here; one that only connects to us shows it as the origin.
        try:
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
        except ValueError:
            host = ""
        if not self.is_own_host(host):
            text = "this is not the gateway's name; gateway.names says which others it has\n"
            raise web.HTTPForbidden(text=text)

    def _check_origin(self, request: web.Request) -> None:
        origin = request.headers.get("Origin")
        if origin is None or origin in self.allowed_origins:  # no browser, or a page that may
            return
        if urlsplit(origin).netloc != request.headers.get("Host"):
            text = (
                "only this gateway's own page may connect, and those of gateway.allowed_origins\n"
            )
            raise web.HTTPForbidden(text=text)

    def _cors(self, request: web.Request) -> dict[str, str]:
        origin = request.headers.get("Origin", "")
        if origin not in self.allowed_origins:
            return {}
        return {"Access-Control-Allow-Origin": origin, "Vary": "Origin", **_READABLE}

    def _check_token(self, request: web.Request) -> None:
        bearer = request.headers.get("Authorization", "").removeprefix("Bearer ")
        given = request.query.get("token", bearer)
        if self.token and not secrets.compare_digest(given.encode(), self.token.encode()):
            text = "the token is missing or wrong; the command that serves the page shows it\n"
            raise web.HTTPForbidden(text=text)
