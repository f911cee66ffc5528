// The gateway's addresses. Its token, if it wants one, stands in the page's address once, behind the
// "#", which no server sees; then it is in this page's memory alone.

let token = null;

function secret() {
  if (token === null) {
    token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    if (token !== "") history.replaceState(null, "", location.pathname + location.search);
  }
  return token;
}

/** Return a path with its query, the token included; empty fields are left out. */
export function pathOf(path, fields = {}) {
  const given = Object.entries({ ...fields, token: secret() }).filter(([, value]) => value !== "");
  return given.length === 0 ? path : `${path}?${new URLSearchParams(given)}`;
}

/** Return the address of a WebSocket. */
export function socketUrl(path, fields) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  return `${scheme}://${location.host}${pathOf(path, fields)}`;
}
