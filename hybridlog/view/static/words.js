/** Numbers, sizes and times in words. Times are whole nanoseconds, as BigInt. */

const SECOND = 1000000000n;
const SIZES = ["B", "kB", "MB", "GB", "TB"];

/** `12,345`. */
export function count(number) {
  return number.toLocaleString("en-US");
}

/** `1 fix` or `12,345 fixes`. */
export function counted(number, one, more = `${one}s`) {
  return `${count(number)} ${number === 1 ? one : more}`;
}

/** `1.2 MB`. */
export function size(bytes) {
  let place = 0;
  let value = bytes;
  while (value >= 1000 && place < SIZES.length - 1) {
    value /= 1000;
    place += 1;
  }
  return `${place ? value.toFixed(1) : value} ${SIZES[place]}`;
}

/** `1:02:03`, `4.2 s`, `35 ms`, `2.1 µs` or `8 ns`, of nanoseconds. */
export function duration(ns) {
  if (ns < 1000) return `${Math.round(ns)} ns`;
  if (ns < 1e6) return `${(ns / 1000).toFixed(ns < 1e4 ? 1 : 0)} µs`;
  const seconds = ns / 1e9;
  if (seconds < 1) return `${(seconds * 1000).toFixed(seconds < 0.01 ? 2 : 0)} ms`;
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  const whole = Math.round(seconds);
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const [hours, minutes, rest] = parts.map((part) => String(part).padStart(2, "0"));
  return parts[0] ? `${parts[0]}:${minutes}:${rest}` : `${parts[1]}:${rest}`;
}

/** `+12.345 s`: a time since the start of a recording, ns. */
export function offset(ns, digits = 3) {
  const unit = 10n ** BigInt(9 - digits);
  const text = String(((ns < 0n ? -ns : ns) + unit / 2n) / unit).padStart(digits + 1, "0");
  const point = text.length - digits;
  return `${ns < 0n ? "−" : "+"}${text.slice(0, point)}${digits ? "." : ""}${text.slice(point)} s`;
}

/** `2026-11-27 10:20:30.123`, UTC, of nanoseconds since 1970 as BigInt. */
export function moment(ns, digits = 3) {
  const second = ns >= 0n ? ns / SECOND : (ns + 1n) / SECOND - 1n;
  const [day, time] = new Date(Number(second) * 1000).toISOString().split("T");
  const rest = String(ns - second * SECOND).padStart(9, "0").slice(0, digits);
  return `${day} ${time.slice(0, 8)}${digits ? "." : ""}${rest}`;
}
