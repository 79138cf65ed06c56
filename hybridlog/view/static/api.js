/** Asks the server. All addresses are relative to the page's own, which has the token. */

/** An answer that is an error; `message` may have several lines, with a caret in the last. */
export class ApiError extends Error {}

const running = new Map();

/**
 * An answer as JSON.
 *
 * @param {string} path such as `recordings`
 * @param {Object} [parameters] lists are repeated; null and undefined are left out
 * @param {{slot?: string, signal?: AbortSignal}} [options] a newer request of the same slot aborts
 *     an older one, which then throws an `AbortError`
 */
export async function get(path, parameters = {}, options = {}) {
  return request(path, parameters, options, (response) => response.json());
}

/** An answer as bytes: an `ArrayBuffer`. */
export async function bytes(path, parameters = {}, options = {}) {
  return request(path, parameters, options, (response) => response.arrayBuffer());
}

/** The address of an answer, for pictures and links. */
export function address(path, parameters = {}) {
  const pairs = new URLSearchParams();
  for (const [name, value] of Object.entries(parameters)) {
    for (const one of Array.isArray(value) ? value : [value]) {
      if (one !== null && one !== undefined) pairs.append(name, one);
    }
  }
  const text = pairs.toString();
  return text ? `${path}?${text}` : path;
}

/** What `read` makes of the response, whose status is 200; until then, it can be aborted. */
export async function request(path, parameters = {}, { slot, signal } = {}, read = (all) => all) {
  const own = new AbortController();
  signal?.addEventListener("abort", () => own.abort());
  if (slot) {
    running.get(slot)?.abort();
    running.set(slot, own);
  }
  try {
    const response = await fetch(address(path, parameters), { signal: own.signal });
    if (response.ok) return await read(response);
    const text = await response.text();
    throw new ApiError(messageOf(text) || `The server answered ${response.status}.`);
  } catch (error) {
    if (error instanceof TypeError) throw new ApiError("The server does not answer: has it ended?");
    throw error;
  } finally {
    if (slot && running.get(slot) === own) running.delete(slot);
  }
}

/** Whether an error only says that a newer request took the place of this one. */
export function isAborted(error) {
  return error.name === "AbortError";
}

function messageOf(text) {
  try {
    return JSON.parse(text).error;
  } catch {
    return text.trim();
  }
}
