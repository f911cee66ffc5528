// Checks the names and values of options.

/** Throw a TypeError if `options` has a name that is not `known`. */
export function checkOptions(options, known) {
  const unknown = Object.keys(options).find((name) => !known.includes(name));
  if (unknown !== undefined) throw new TypeError(`unknown option ${unknown}; use ${known.join(", ")}`);
}

/** Return a number, or throw a RangeError with its name if it is not from `lowest` to `highest`. */
export function inRange(name, value, lowest, highest) {
  if (typeof value === "number" && value >= lowest && value <= highest) return value;
  throw new RangeError(`${name} is ${value}; it must be a number from ${lowest} to ${highest}`);
}
