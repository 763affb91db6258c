/** Errors that people can do something about. */

/** An error whose message is for people: what is wrong, and what to do. */
export class PageError extends Error {
  name = "PageError";
}

/**
 * Return words for any error.
 * @param {unknown} error
 * @returns {string}
 */
export function wordsFor(error) {
  if (error instanceof PageError) {
    return error.message;
  }
  const text = String(error?.message ?? error);
  if (error instanceof RangeError || /memory|allocation|bad_alloc/i.test(text)) {
    return "This device has too little memory free. Close other tabs, and load the page again.";
  }
  return `Something failed: ${text}. Load the page again.`;
}
