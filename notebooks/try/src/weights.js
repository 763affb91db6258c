/** Download of the networks, and their place in the browser's cache. */

import { PageError } from "./errors.js";

const CACHE = "completesplat-try-weights";

/**
 * @typedef {object} Listed a file that the page loads (`files.json`)
 * @property {string} path
 * @property {number} bytes
 * @property {string} hash
 */

/** Downloads files that are listed, once. */
export class Downloads {
  /**
   * @param {Listed[]} files
   * @param {(loaded: number, total: number) => void} onProgress
   */
  constructor(files, onProgress) {
    this.files = files;
    this.onProgress = onProgress;
    this.loaded = 0;
    this.total = files.reduce((sum, { bytes }) => sum + bytes, 0);
    this.areStored = true;
  }

  /** @returns {Promise<Map<string, Uint8Array>>} contents by path */
  async load() {
    const cache = await openedCache();
    const contents = new Map();
    for (const file of this.files) {
      contents.set(file.path, await this.loadFile(file, cache));
    }
    await this.forgetOthers(cache);
    return contents;
  }

  async loadFile(file, cache) {
    const address = addressOf(file);
    const stored = await cache?.match(address);
    const response = stored ?? (await fetched(address));
    const content = await this.contentOf(response, file);
    if (!stored) {
      await this.store(cache, address, content);
    }
    return content;
  }

  async contentOf(response, file) {
    const content = new Uint8Array(file.bytes);
    const before = this.loaded;
    let length = 0;
    const reader = response.body.getReader();
    for (let part = await read(reader); !part.done; part = await read(reader)) {
      if (length + part.value.length > content.length) {
        throw new PageError(`${file.path} has changed on the server. Load the page again.`);
      }
      content.set(part.value, length);
      length += part.value.length;
      this.loaded = before + length;
      this.onProgress(this.loaded, this.total);
    }
    if (length < content.length) {
      throw new PageError(`${file.path} is not complete on the server. Try again later.`);
    }
    return content;
  }

  async store(cache, address, content) {
    try {
      await cache.put(address, new Response(content));
    } catch { // there is no cache, or no room in it
      this.areStored = false;
    }
  }

  /** Remove what earlier versions of the page have stored. */
  async forgetOthers(cache) {
    const current = new Set(this.files.map(addressOf));
    for (const request of (await cache?.keys()) ?? []) {
      if (!current.has(request.url)) {
        await cache.delete(request);
      }
    }
  }
}

/** @returns {Promise<Cache | null>} null where pages may not store, such as in private windows */
async function openedCache() {
  try {
    return await caches.open(CACHE);
  } catch {
    return null;
  }
}

/** @param {Listed} file */
function addressOf({ path, hash }) {
  return new URL(`${path}?v=${hash}`, self.location.href).href;
}

/** @param {string} address */
async function fetched(address) {
  let response;
  try {
    response = await fetch(address);
  } catch {
    throw new PageError("The networks cannot be loaded: the connection is lost. Try again when it is back.");
  }
  if (!response.ok) {
    throw new PageError(`The networks are missing on the server (${response.status}). Tell whoever runs it.`);
  }
  return response;
}

async function read(reader) {
  try {
    return await reader.read();
  } catch {
    throw new PageError("The connection was lost while the networks were loading. Try again when it is back.");
  }
}
