// Checks the names of options.

/** Throw a TypeError if `options` has a name that is not `known`. */
export function checkOptions(options, known) {
  const unknown = Object.keys(options).find((name) => !known.includes(name));
  if (unknown !== undefined) throw new TypeError(`unknown option ${unknown}; use ${known.join(", ")}`);
}
