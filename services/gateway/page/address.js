// Addresses of the gateway. The page's URL contains the token after "#", which browsers do not send
// to servers. The page removes the token from the URL. This tab keeps it for the next reload.

const STORED_TOKEN = "kouxing.token";

let token = null;

function takeToken() {
  if (token === null) {
    token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    if (token !== "") history.replaceState(null, "", location.pathname + location.search);
    token = storedToken(token);
  }
  return token;
}

/** Store a token until this tab closes. Return it; if it is "", return the token that is stored. */
function storedToken(given) {
  try {
    if (given !== "") sessionStorage.setItem(STORED_TOKEN, given);
    return given || (sessionStorage.getItem(STORED_TOKEN) ?? "");
  } catch {
    return given; // the browser forbids storage
  }
}

/** Return a path with a query of the fields and the token. Empty fields are omitted. */
export function pathWithToken(path, fields = {}) {
  const query = Object.entries({ ...fields, token: takeToken() }).filter(([, value]) => value !== "");
  return query.length === 0 ? path : `${path}?${new URLSearchParams(query)}`;
}

/** Return the URL of a WebSocket. */
export function socketUrl(path, fields) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  return `${scheme}://${location.host}${pathWithToken(path, fields)}`;
}

/** Return whether the gateway runs but rejects the token, because it was started again with another one. */
export async function isTokenWrong() {
  try {
    return (await fetch(pathWithToken("/viewer"))).status === 403;
  } catch {
    return false; // it does not answer
  }
}

/** Return whether the page's URL shows that the gateway runs on this computer. */
export function isThisComputer() {
  return ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
}
