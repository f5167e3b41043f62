// Licensed under a 3-clause BSD style license - see LICENSE
/* Ask the search of a built site, with its own scripts: node check_search.js HTML */

const fs = require("fs"), path = require("path"), vm = require("vm");

// what people type, and pages of which one has to come first
const QUESTIONS = {
  "how do i fix a parameter": ["fit_settings", "faq"],
  "fix a parameter": ["fit_settings", "faq"],
  "load a calibration in a pipeline": ["faq", "pipelines"],
  "pipeline": ["pipelines"],
  "trust": ["parameters", "trust"],
  "which parameters can i trust": ["parameters", "faq"],
  "units": ["conventions", "faq"],
  "correct science images": ["correction"],
  "install": ["installation"],
  "calibrate": ["first_calibration", "commands/calibrate"],
  "diagnose": ["diagnosis", "commands/diagnose"],
  "half-wave plate angle": ["conventions"],
  "standard stars": ["standards"],
  "reduce cubes": ["reduction", "commands/reduce"],
  "archive": ["archives"],
  "prior": ["fit_settings", "faq"],
};

const root = process.argv[2];
const element = () => new Proxy(function () {}, {
  get: (_, key) => (key === Symbol.toPrimitive ? () => "" : key === "lastChild" ? null : element()),
  apply: () => element(),
  set: () => true,
});
const sandbox = {
  console, document: element(), location: element(), localStorage: element(), URLSearchParams,
  SPHINX_HIGHLIGHT_ENABLED: false, DOCUMENTATION_OPTIONS: {}, _ready: () => {}, _: (x) => x,
};
sandbox.window = sandbox;
vm.createContext(sandbox);
for (const name of ["_static/language_data.js", "_static/search_scorer.js", "_static/searchtools.js"]) {
  const file = path.join(root, name);
  if (fs.existsSync(file)) vm.runInContext(fs.readFileSync(file, "utf8"), sandbox);
}
vm.runInContext("this.Search = Search; Search.query = () => {};", sandbox);
vm.runInContext(fs.readFileSync(path.join(root, "searchindex.js"), "utf8"), sandbox);
let wrong = 0;
for (const [question, pages] of Object.entries(QUESTIONS)) {
  const parsed = JSON.stringify(question);
  const found = vm.runInContext(
    `Search._performSearch(...Search._parseQuery(${parsed})).reverse().map((r) => r[0])`, sandbox);
  if (!pages.includes(found[0])) {
    wrong += 1;
    console.error(`"${question}" finds ${found.slice(0, 4).join(", ")}; wanted ${pages.join(" or ")}`);
  }
}
console.log(`${Object.keys(QUESTIONS).length - wrong} of ${Object.keys(QUESTIONS).length} questions find their page first`);
process.exit(wrong ? 1 : 0);
