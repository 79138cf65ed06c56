/** Types of messages, by their names in ROS 1: ROS 2 has `/msg/` in them. */

/** A test for topics whose messages have one of some types. */
export function ofTypes(...names) {
  const known = new Set(names);
  return ({ type }) => known.has(type.replace("/msg/", "/"));
}
