/** Earlier questions of the bar. */

const HISTORY = "hybridlog.questions";
const MOST = 100;

/**
 * Earlier questions, which stay in this browser.
 *
 * @returns {{add: function(Object), step: function(number, Object): Object|null}} `step` gives the
 *     question so many steps later; the one behind the last is `now`
 */
export function questionHistory() {
  let place = null;
  let draft = null;
  return { add, step };

  function add(question) {
    const text = JSON.stringify(question);
    const others = load().filter((one) => JSON.stringify(one) !== text);
    place = null;
    try {
      localStorage.setItem(HISTORY, JSON.stringify([...others, question].slice(-MOST)));
    } catch {
      // Without storage, there is no history.
    }
  }

  function step(by, now) {
    const known = load();
    if (place === null) draft = now;
    const next = (place ?? known.length) + by;
    if (next < 0 || next > known.length) return null;
    place = next === known.length ? null : next;
    return place === null ? draft : known[place];
  }

  function load() {
    try {
      const found = JSON.parse(localStorage.getItem(HISTORY));
      return Array.isArray(found) ? found.filter((one) => typeof one?.text === "string") : [];
    } catch {
      return [];
    }
  }
}
