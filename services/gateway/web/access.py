"""Access control for HTTP requests: host names, origins of other pages, and the token."""

import secrets
from collections.abc import Callable, Collection
from dataclasses import dataclass
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from kouxing.shared.settings.endpoints import is_loopback

_PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, POST, DELETE",
    "Access-Control-Allow-Headers": "Authorization, Content-Type",
}
_READABLE = {"Access-Control-Expose-Headers": "Location, Retry-After, Kouxing-Remarks"}


@dataclass(frozen=True, slots=True, kw_only=True)
class AccessPolicy:
    """The conditions that an HTTP request must meet."""

    is_gateway_host: Callable[[str], bool] = is_loopback
    """Returns whether a host name or address is the gateway's."""
    token: str = ""
    """Secret that private paths require. If empty, they require no token."""
    trusted_origins: Collection[str] = ()
    """Origins of other pages that may connect."""
    proxy_schemes: Collection[str] = ()
    """Schemes of the page's origin that a proxy may use, in addition to the connection's."""

    def middleware(self, private_paths: Collection[str]) -> Middleware:
        """Return middleware that rejects requests with status 403.

        Every request must name a host of the gateway. Requests for ``private_paths`` must also
        come from an allowed origin and carry the token. Pages of allowed origins can read the
        answers (CORS).
        """

        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            self._check_host(request)
            if request.method == "OPTIONS":  # a browser's preflight for a page of another origin
                self._check_origin(request)
                return web.Response(status=204, headers={**_PREFLIGHT, **self._cors(request)})
            resource = request.match_info.route.resource
            pattern = resource.canonical if resource is not None else ""
            if request.path not in private_paths and pattern not in private_paths:
                return await handler(request)
            try:
                self._check_origin(request)
                self._check_token(request)
                response = await handler(request)
            except web.HTTPException as error:
                error.headers.update(self._cors(request))
                raise
            if not response.prepared:
                response.headers.update(self._cors(request))
            return response

        return check

    def _check_host(self, request: web.Request) -> None:
        # DNS rebinding: a foreign page whose name resolves to this machine sends its own name as
        # the host. The origin check rejects a foreign page that only connects here.
        try:
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
        except ValueError:
            host = ""
        if not self.is_gateway_host(host):
            text = f"{host!r} is not a name of this gateway; add it to gateway.names\n"
            raise web.HTTPForbidden(text=text)

    def _check_origin(self, request: web.Request) -> None:
        origin = request.headers.get("Origin")
        if origin is None or origin in self.trusted_origins:  # None: not a browser
            return
        schemes = {request.scheme, *self.proxy_schemes}
        if origin not in {f"{scheme}://{request.headers.get('Host')}" for scheme in schemes}:
            text = (
                f"connections from {origin!r} are not allowed;"
                " add the origin to gateway.trusted_origins\n"
            )
            raise web.HTTPForbidden(text=text)

    def _cors(self, request: web.Request) -> dict[str, str]:
        origin = request.headers.get("Origin", "")
        if origin not in self.trusted_origins:
            return {}
        return {"Access-Control-Allow-Origin": origin, "Vary": "Origin", **_READABLE}

    def _check_token(self, request: web.Request) -> None:
        bearer = request.headers.get("Authorization", "").removeprefix("Bearer ")
        token = request.query.get("token", bearer)
        if self.token and not secrets.compare_digest(ascii(token), ascii(self.token)):
            text = "the token is missing or wrong; use the full URL that kouxing printed\n"
            raise web.HTTPForbidden(text=text)
