// A policy's contract as tables: what it observes, element by element, what it does, and where it came from.

import { clip, element, labelCells, number, setText, showFacts, stamp, table } from "./dom.js";

const MOST_ELEMENTS = 128; // of a leaf; an image's pixels are no rows each, nor series of the metrics
const MOST_ROWS = 512; // of a table
const FILTER = "mean_std_filter";
const FAR = 1; // [standard deviations of the training] of a shift worth a look, as in the Grafana dashboard
const BOUNDED = ["#", "Element", "Unit", "Low", "High"];
const COMPARED = ["Mean in training", "Spread in training", "Shift now [σ]", "Spread now"];

/** Return the contract as a node, and a function that shows a drift (`driftOf`) in it. */
export function showContract(contract) {
  const rows = new Map(); // label in the metrics -> cells of the drift
  const node = element("div", { class: "contract" });
  node.append(element("h3", { text: `Contract of ${contract.name}, version ${contract.version}` }));
  const facts = element("dl");
  showFacts(facts, factsOf(contract));
  node.append(facts);
  node.append(observations(contract, rows), actions(contract));
  node.append(element("h4", { text: "Baked into the graph, in this order" }), steps(contract.baked_in));
  labelCells(node);
  return { node, showDrift: (drift) => showDrift(rows, drift) };
}

/** Return whether an element's observations are far from those of the training. */
export function isFar({ shift }) {
  return Math.abs(shift) > FAR;
}

function factsOf(contract) {
  const { provenance, parity, distribution } = contract;
  const trained = [
    provenance.env_id && `in ${provenance.env_id}`,
    provenance.training_iterations && `${provenance.training_iterations} iterations`,
    provenance.env_steps && `${provenance.env_steps} steps`,
  ];
  const framework = provenance.api_stack
    ? `RLlib's ${provenance.api_stack} API stack, Ray ${provenance.ray_version}`
    : provenance.framework;
  const proven = Object.entries(parity.formats).map(
    ([format, { max_abs: most }]) => `${format}: largest difference ${number(most, 2)}`,
  );
  return [
    ["Description", clip(contract.description)],
    ["Algorithm", `${provenance.algorithm} (${framework})`],
    ["Trained", trained.filter(Boolean).join(", ")],
    ["Exported", stamp(provenance.exported_at)],
    ["Control rate", contract.control_rate_hz && `${number(contract.control_rate_hz)} Hz`],
    ["Memory", contract.state.map(({ name, shape }) => `${name} (${shape.join(", ")})`).join(", ")],
    ["Exploring", distribution ? distribution.kind.replaceAll("_", " ") : "not possible"],
    ["In closed loop", contract.evaluations.map(sayRun).join("; ")],
    ["Proven", `${parity.samples} observations against ${parity.reference}; ${proven.join("; ")}`],
  ];
}

function sayRun(run) {
  const say = (kind) => {
    const [reward, share] = [run[`return_${kind}`], run[`success_rate_${kind}`]];
    return `return ${number(reward)}${share === null ? "" : `, success ${number(100 * share)}%`}`;
  };
  return `${run.episodes} episodes of ${run.env_id}: ${say("bundle")} (the checkpoint: ${say("checkpoint")})`;
}

function observations(contract, rows) {
  const { region, body } = table("Observation, element by element", [...BOUNDED, ...COMPARED]);
  const filter = filterOf(contract);
  for (const row of rowsOf(contract.observation_space, "obs")) {
    const shift = element("td", { class: "number" });
    const spread = element("td", { class: "number" });
    const trained = [filter?.mean[row.index], filter?.std[row.index]].map((value) => number(value));
    body.append(line(row, ...trained.map((text) => element("td", { class: "number", text })), shift, spread));
    rows.set(row.label, { shift, spread });
  }
  return region;
}

function actions(contract) {
  const { region, body } = table("Action, ready for the environment's step", BOUNDED);
  for (const row of rowsOf(contract.action_space, "action")) body.append(line(row));
  return region;
}

function line({ index, name, unit, low, high }, ...more) {
  return element(
    "tr",
    {},
    element("td", { class: "number", text: String(index) }),
    element("th", { scope: "row", class: "given", text: clip(name, 200) }),
    element("td", { class: "given", text: clip(unit, 50) }),
    ...[low, high].map((bound) => element("td", { class: "number", text: number(bound) })),
    ...more,
  );
}

/** Return the rows of a space, no more than a page can show. */
function rowsOf(space, path) {
  const rows = [];
  for (const row of elements(space, path)) {
    if (rows.length === MOST_ROWS) return [...rows, { index: "…", name: "and more", unit: "", label: null }];
    rows.push(row);
  }
  return rows;
}

/** Yield a row for each element of a space: of nested spaces leaf by leaf, of a large leaf one for all of it. */
function* elements(space, path) {
  if (space.kind === "dict" || space.kind === "tuple") {
    const keys = Object.keys(space.spaces);
    if (space.kind === "dict") keys.sort(); // as RLlib has them
    for (const key of keys) yield* elements(space.spaces[key], `${path}.${key}`);
    return;
  }
  const size = (space.shape ?? []).reduce((product, axis) => product * axis, 1);
  if (size > MOST_ELEMENTS) {
    const name = `${path}: ${space.dtype}, shape (${space.shape.join(", ")}), all ${size} elements`;
    yield { index: 0, name, unit: "", ...extent(space, size), label: "largest" };
    return;
  }
  const names = (space.elements ?? []).map(({ name }) => name);
  const unique = new Set(names).size === size;
  for (let index = 0; index < size; index++) {
    const [low, high] = bounds(space, index);
    const numbered = index in names ? `${index} (${names[index]})` : String(index);
    const name = names[index] ?? (size === 1 ? path : `${path}[${index}]`);
    yield { index, name, unit: space.elements?.[index]?.unit ?? "", low, high, label: unique ? name : numbered };
  }
}

/** Return the lowest and the highest bound of a large leaf. */
function extent(space, size) {
  const sides = [0, 1].map((side) => Array.from({ length: size }, (_, index) => bounds(space, index)[side]));
  const [low, high] = [Math.min, Math.max].map((most, side) => sides[side].reduce((a, b) => most(a, b)));
  return { low, high };
}

function bounds(space, index) {
  const at = (bound) => (Array.isArray(bound) ? bound[index] : bound);
  switch (space.kind) {
    case "box":
      return [at(space.low) ?? -Infinity, at(space.high) ?? Infinity];
    case "discrete":
      return [space.start, space.start + space.n - 1];
    case "multi_discrete":
      return [space.start[index], space.start[index] + space.nvec[index] - 1];
    default:
      return [0, 1];
  }
}

/** Return {mean, std} of the filter over the raw observation, where there is one: what drift is measured against. */
function filterOf(contract) {
  const [first] = contract.baked_in;
  if (contract.observation_space.kind !== "box" || first?.step !== FILTER) return null;
  const [mean, std] = ["mean", "std"].map((name) => [first.values[name] ?? []].flat(Infinity));
  return mean.length > MOST_ELEMENTS ? null : { mean, std };
}

function steps(baked) {
  return element(
    "ol",
    {},
    ...baked.map(({ step, detail }) =>
      element("li", { class: "given", text: step.replaceAll("_", " ") + (detail && `: ${clip(detail, 500)}`) }),
    ),
  );
}

function showDrift(rows, drift) {
  for (const [label, { shift, spread }] of rows) {
    const now = drift?.get(label);
    setText(shift, now === undefined ? "–" : number(now.shift, 3) + (isFar(now) ? " far" : ""));
    setText(spread, now === undefined ? "–" : number(now.spread, 3));
    shift.classList.toggle("far", now !== undefined && isFar(now));
  }
}
