// Keeps the page's files, so that it works offline after the first visit. build.mjs adds FILES and
// VERSION; other files, such as more heads, are kept when they are first used.

/* global FILES, VERSION */

self.addEventListener("install", (event) => {
  event.waitUntil(caches.open(VERSION).then((cache) => cache.addAll(FILES)));
  self.skipWaiting();
});

self.addEventListener("activate", (event) => {
  const deleteOthers = async () => {
    for (const name of await caches.keys()) if (name !== VERSION) await caches.delete(name);
    await self.clients.claim();
  };
  event.waitUntil(deleteOthers());
});

self.addEventListener("fetch", (event) => {
  if (event.request.method === "GET" && event.request.url.startsWith(self.registration.scope)) event.respondWith(cachedResponse(event.request));
});

async function cachedResponse(request) {
  const cache = await caches.open(VERSION);
  const cached = await cache.match(request, { ignoreSearch: true });
  if (cached) return cached;
  const response = await fetch(request); // with status 206 for a part of a file, which cannot be cached
  if (response.status === 200) await cache.put(request, response.clone());
  return response;
}
