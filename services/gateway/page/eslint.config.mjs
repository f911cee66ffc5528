// Rules for the page's code. Because of its suffix, the gateway does not serve this file.

import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  {
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      curly: ["error", "multi-line"],
      eqeqeq: "error",
      "no-shadow": "error",
      "no-unused-vars": ["error", { argsIgnorePattern: "^_" }],
      "no-use-before-define": ["error", { functions: false, variables: false }],
      "no-var": "error",
      "object-shorthand": "error",
      "prefer-const": "error",
    },
  },
  { files: ["*.js"], languageOptions: { globals: globals.browser } },
  { files: ["engine/*.js", "demo/*.js"], languageOptions: { globals: globals.browser } },
  { files: ["*-worklet.js", "worklet.js"], languageOptions: { globals: globals.audioWorklet } },
  { files: ["worker.js", "demo/service-worker.js"], languageOptions: { globals: { ...globals.worker, ...globals.serviceworker } } },
  { files: ["*.test.mjs", "tests/*.js"], languageOptions: { globals: globals.node } },
];
