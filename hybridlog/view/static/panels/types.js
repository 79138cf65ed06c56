/** Types of messages, by their names in ROS 1: ROS 2 has `/msg/` in them. */

/** A test for topics whose messages have one of some types. */
export function ofTypes(...names) {
  const known = new Set(names);
  return ({ type }) => known.has(type.replace("/msg/", "/"));
}

const GROUPS = [
  /^(Log|DiagnosticArray)$/, // what tells of trouble
  /Image|Camera|Video/,
  /Scan|Cloud|Range|Lidar|Radar|Grid/,
  /Odom|Pose|Path|NavSat|Location|GPS/i,
  /Imu|Twist|Wrench|Accel|Joint|Motor|Wheel|Command|Battery|Temperature|Magnetic|Pressure/,
  /TFMessage|Transform/,
  /Diagnostic|String|Status|Event|Mark$/,
];

/** The number of the group of a type; types of no group come last. */
export function groupOf(type) {
  const name = shortType(type);
  const found = GROUPS.findIndex((pattern) => pattern.test(name));
  return found < 0 ? GROUPS.length : found;
}

/** `Imu` of `sensor_msgs/msg/Imu`. */
export function shortType(type) {
  return type.split(/[/.]/).at(-1);
}
