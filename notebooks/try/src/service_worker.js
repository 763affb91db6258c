/** The page without a connection: its files are stored when it is first opened, the networks when they are loaded. */

/* global FILES, VERSION: build.mjs puts them in */
const CACHE = `completesplat-try-page-${VERSION}`;

self.addEventListener("install", (event) => {
  event.waitUntil(stored());
});

self.addEventListener("activate", (event) => {
  event.waitUntil(begun());
});

self.addEventListener("fetch", (event) => {
  if (event.request.method === "GET" && new URL(event.request.url).origin === self.location.origin) {
    event.respondWith(answered(event.request));
  }
});

async function stored() {
  const cache = await caches.open(CACHE);
  await cache.addAll(FILES.map((file) => new Request(file, { cache: "no-cache" })));
  await self.skipWaiting();
}

async function begun() {
  for (const name of await caches.keys()) {
    if (name.startsWith("completesplat-try-page-") && name !== CACHE) {
      await caches.delete(name);
    }
  }
  await self.clients.claim();
}

async function answered(request) {
  const isPage = request.mode === "navigate";
  const cache = await caches.open(CACHE);
  return (await cache.match(isPage ? "./" : request)) ?? fetch(request);
}
