/** Asks the server. All addresses are relative to the page's own, which has the token. */

/** An answer that is an error; `message` may have several lines, with a caret in the last. */
export class ApiError extends Error {}

/**
 * An answer as JSON.
 *
 * @param {string} path such as `recordings`
 * @param {Object} [parameters] lists are repeated; null and undefined are left out
 * @param {{signal?: AbortSignal}} [options] when it is aborted, this throws an `AbortError`
 */
export async function get(path, parameters = {}, options = {}) {
  return request(path, parameters, options, (response) => response.json());
}

/** An answer as bytes: an `ArrayBuffer`. */
export async function bytes(path, parameters = {}, options = {}) {
  return request(path, parameters, options, (response) => response.arrayBuffer());
}

/** The address of an answer. */
function address(path, parameters = {}) {
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
export async function request(path, parameters = {}, { signal } = {}, read = (all) => all) {
  try {
    const response = await fetch(address(path, parameters), { signal });
    if (response.ok) return await read(response);
    const text = await response.text();
    throw new ApiError(messageOf(text) || `The server answered ${response.status}.`);
  } catch (error) {
    if (error instanceof TypeError) throw new ApiError("The server does not answer: has it ended?");
    throw error;
  }
}

/** Questions of one kind, of which only the newest matters. Those before throw an `AbortError`. */
export class Question {
  #stop = new AbortController();
  #answer = Promise.resolve();
  #newest = 0;

  /** Asks, by `get` or `bytes`, and gives up what is under way. */
  ask(path, parameters, by = get) {
    this.stop();
    return this.update(path, parameters, by);
  }

  /** Asks the same of a recording that has gone on, once what is under way is answered. */
  async update(path, parameters, by = get) {
    const { signal } = this.#stop;
    const own = (this.#newest += 1);
    await this.#answer;
    if (signal.aborted || own !== this.#newest) throw new DOMException("Given up", "AbortError");
    const answer = by(path, parameters, { signal });
    this.#answer = answer.catch(() => {});
    return answer;
  }

  /** Gives up what is under way: it stops on the server, too. */
  stop() {
    this.#stop.abort();
    this.#stop = new AbortController();
    this.#answer = Promise.resolve();
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
