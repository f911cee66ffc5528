/**
 * Return the URL of one of the gateway's WebSockets.
 *
 * @param gateway address of the gateway, such as "http://localhost:8080"
 * @param path "/viewer" or "/microphone"
 * @param fields of the query; empty ones are left out
 */
export function socketUrl(gateway, path, fields) {
  const url = new URL(path, gateway);
  url.protocol = url.protocol.replace("http", "ws");
  for (const [name, value] of Object.entries(fields)) if (value) url.searchParams.set(name, value);
  return url.href;
}
