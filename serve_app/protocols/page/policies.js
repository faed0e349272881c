// The policies on the page: a section for each, with its versions, a curve of its requests and an open contract.

import { isFar, number, showContract } from "./contract.js";
import { clip, drawing, element, keep, setText, showFacts, table } from "./dom.js";
import { driftOf } from "./metrics.js";

const PRODUCTION = "production";
const COLUMNS = [
  "Version",
  "State",
  "Aliases",
  "Requests",
  "Per second",
  "Failures",
  "Latency p50 / p99",
  "Drift",
  "Contract",
];
const NUMBERS = new Set(["Requests", "Per second", "Latency p50 / p99"]);
const CURVE_S = 120;
const WIDTH = 240;
const HEIGHT = 36;

const sections = new WeakMap(); // section -> what is in it

/**
 * Show all policies. `listing` is `/v1/policies`' reply, each version with its `states` on all replicas; `looks` are
 * the metrics', `askContract` asks for a contract, `at` is the time [s].
 */
export function showPolicies(main, listing, { looks, askContract, at }) {
  keep(
    main,
    listing.policies,
    ({ name }) => name,
    (policy) => makeSection(policy, askContract),
    (section, policy) => updateSection(sections.get(section), policy, looks, at),
  );
}

function makeSection({ name }, askContract) {
  const id = `policy-${name}`;
  const versions = table(`Versions of ${name}`, COLUMNS);
  const parts = {
    description: element("p", { class: "given" }),
    facts: element("dl"),
    versions,
    line: drawing("polyline"),
    curve: null,
    curveText: element("p", { class: "note" }),
    rates: [],
    success: { line: drawing("polyline"), curve: null, text: element("p", { class: "note" }) },
    contract: element("div", { id: `${id}-contract` }),
    shown: null, // {version, showDrift} of the open contract
    askContract,
  };
  const size = { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none" };
  parts.curve = drawing("svg", { class: "curve", role: "img", ...size }, parts.line);
  parts.success.curve = drawing("svg", { class: "curve", role: "img", ...size }, parts.success.line);
  const section = element(
    "section",
    { class: "policy", "aria-labelledby": id },
    element("h2", { id, text: name }),
    parts.description,
    parts.facts,
    element("div", { class: "rates" }, parts.curve, parts.curveText),
    element("div", { class: "rates" }, parts.success.curve, parts.success.text),
    versions.region,
    parts.contract,
  );
  sections.set(section, parts);
  return section;
}

function updateSection(parts, policy, looks, at) {
  setText(parts.description, clip(policy.description));
  parts.description.hidden = policy.description === "";
  showFacts(parts.facts, factsOf(policy, looks));
  drawCurve(parts, looks.rate("rlservo_requests_total", { policy: policy.name, code: "ok" }), at);
  drawSuccess(parts.success, successes(policy.name, looks));
  keep(
    parts.versions.body,
    policy.version_states,
    ({ version }) => version,
    ({ version }) => makeRow(parts, policy.name, version),
    (row, status) => updateRow(row, policy, status, looks),
  );
  if (!policy.version_states.some(({ version }) => version === parts.shown?.version)) closeContract(parts);
  parts.shown?.showDrift?.(driftOf(looks.newest, { policy: policy.name, version: parts.shown.version }));
}

function factsOf(policy, looks) {
  const { name, canary, shadow } = policy;
  const before = policy.previous[PRODUCTION];
  const aliases = Object.entries(policy.aliases).filter(([alias]) => alias !== PRODUCTION);
  const count = (family) => looks.total(family, { policy: name });
  return [
    ["In use", `version ${policy.version}${before ? ` (a rollback leads to ${before})` : ""}`],
    ["Aliases", aliases.map(([alias, version]) => `${alias} leads to ${version}`).join(", ")],
    ["Canary", canary && sayCanary(canary)],
    ["Shadow", shadow && `version ${shadow.version} computes along; ${compared(policy, looks)}`],
    ["Control rate", policy.control_rate_hz && `${number(policy.control_rate_hz)} Hz`],
    ["WebSockets", count("rlservo_streams") ? `${count("rlservo_streams")} open` : ""],
    ["Sessions", count("rlservo_sessions") ? `${count("rlservo_sessions")} kept` : ""],
  ];
}

/** Return a canary in words. */
export function sayCanary({ version, share }) {
  return `version ${version} gets ${number(100 * share)}% of the sessions`;
}

function compared({ name, shadow }, looks) {
  const wanted = { policy: name, shadow: shadow.version };
  const count = looks.total("rlservo_shadow_difference_count", wanted);
  const missed = looks.total("rlservo_shadow_missed_total", wanted);
  if (count === 0) return `nothing is compared yet${missed ? `, ${missed} actions were missed` : ""}`;
  const mean = looks.total("rlservo_shadow_difference_sum", wanted) / count;
  return `${count} actions compared, mean difference ${number(mean, 3)}, ${missed} missed`;
}

function makeRow(parts, name, version) {
  const kinds = COLUMNS.slice(1, -1).map((column) => (NUMBERS.has(column) ? { class: "number" } : {}));
  const cells = kinds.map((kind) => element("td", kind));
  const button = element("button", {
    type: "button",
    text: "Contract",
    "aria-label": `Contract of ${name}, version ${version}`,
    "aria-expanded": "false",
    "aria-controls": parts.contract.id,
    onclick: () => toggleContract(parts, name, version),
  });
  return element("tr", {}, element("th", { scope: "row", text: version }), ...cells, element("td", {}, button));
}

function updateRow(row, policy, status, looks) {
  const wanted = { policy: policy.name, version: status.version };
  const answered = { ...wanted, code: "ok" };
  const codes = looks.totalBy("rlservo_requests_total", "code", wanted);
  codes.delete("ok");
  const failures = [...codes].filter(([, count]) => count > 0);
  const latency = looks.quantiles("rlservo_request_seconds", wanted, [0.5, 0.99]);
  const drift = driftOf(looks.newest, wanted);
  const texts = [
    sayStates(status),
    status.aliases.join(", "),
    count(looks.total("rlservo_requests_total", answered)),
    number(looks.rate("rlservo_requests_total", answered), 3),
    failures.map(([code, times]) => `${code} ${count(times)}`).join(", ") || "0",
    sayLatency(latency),
    sayDrift(drift, looks, wanted),
  ];
  texts.forEach((text, index) => setText(row.children[index + 1], text));
  row.classList.toggle("in-use", status.version === policy.version);
  row.classList.toggle("failed", status.state === "failed");
  row.children[5].classList.toggle("far", failures.length > 0);
  row.children[7].classList.toggle("far", drift !== null && [...drift.values()].some(isFar));
}

function sayStates({ states, reason }) {
  const counts = [...new Set(states)].map((state) => [state, states.filter((each) => each === state).length]);
  const every = counts.length === 1 ? states[0] : counts.map(([state, times]) => `${state} on ${times}`).join(", ");
  return every + (reason && `: ${clip(reason, 500)}`);
}

function sayLatency({ quantiles: [median, high], recent }) {
  if (median === null) return "–";
  const ms = (seconds) => (Number.isFinite(seconds) ? number(1e3 * seconds, 2) : "over 1000");
  return `${ms(median)} / ${ms(high)} ms${recent ? "" : ", earlier"}`;
}

function sayDrift(drift, looks, wanted) {
  if (drift === null) {
    const measured = looks.has("rlservo_observation_looks_total", wanted);
    return measured ? "nothing seen yet" : "no filter to compare with";
  }
  const [name, { shift }] = [...drift].reduce((a, b) => (Math.abs(b[1].shift) > Math.abs(a[1].shift) ? b : a));
  const far = [...drift.values()].filter(isFar).length;
  return `${far > 0 ? `${far} of ${drift.size} far; ` : ""}most ${number(shift, 2)} σ: ${clip(name, 60)}`;
}

function count(value) {
  return Math.round(value).toLocaleString("en");
}

function drawCurve(parts, rate, at) {
  if (rate !== null) parts.rates.push([at, rate]);
  parts.rates = parts.rates.filter(([time]) => time >= at - CURVE_S);
  const begin = parts.rates[0]?.[0] ?? at;
  const most = Math.max(1, ...parts.rates.map(([, value]) => value));
  const x = (time) => (WIDTH * (time - begin)) / (at - begin || 1);
  const y = (value) => HEIGHT - 1 - ((HEIGHT - 2) * value) / most;
  parts.line.setAttribute("points", parts.rates.map(([t, v]) => `${x(t).toFixed(1)},${y(v).toFixed(1)}`).join(" "));
  const highest = Math.max(0, ...parts.rates.map(([, value]) => value));
  const text =
    rate === null
      ? "Requests a second: from the next look on"
      : `${number(rate, 3)} requests a second; at most ${number(highest, 3)} in the last two minutes`;
  setText(parts.curveText, text);
  parts.curve.setAttribute("aria-label", `Curve: ${text}`);
}

/** Return [version, episodes that ended, share of success], the oldest version first, also of those unloaded since. */
function successes(policy, looks) {
  const ends = "rlservo_episode_ends_total";
  const good = looks.totalBy(ends, "version", { policy, outcome: "success" });
  const by = (version) => version.split(".").map(Number);
  const order = ([a], [b]) => by(a).map((part, at) => part - (by(b)[at] ?? 0)).find(Boolean) ?? 0;
  return [...looks.totalBy(ends, "version", { policy })]
    .filter(([, count]) => count > 0)
    .sort(order)
    .map(([version, count]) => [version, count, (good.get(version) ?? 0) / count]);
}

function drawSuccess({ line, curve, text }, all) {
  curve.parentElement.hidden = all.length === 0;
  if (all.length === 0) return;
  const x = (at) => (all.length > 1 ? (WIDTH * at) / (all.length - 1) : 0);
  const y = (share) => HEIGHT - 1 - (HEIGHT - 2) * share;
  line.setAttribute("points", all.map(([, , share], at) => `${x(at).toFixed(1)},${y(share).toFixed(1)}`).join(" "));
  const say = ([version, episodes, share]) => `${number(100 * share, 3)}% of ${count(episodes)} with ${version}`;
  const ends = all.length > 1 ? [all[0], all.at(-1)] : all;
  setText(text, `Episodes that succeeded, by version: ${ends.map(say).join(", … ")}`);
  curve.setAttribute("aria-label", `Curve: ${text.textContent}`);
}

async function toggleContract(parts, name, version) {
  const wasOpen = parts.shown?.version === version;
  closeContract(parts);
  if (wasOpen) return;
  const shown = { version, showDrift: null };
  parts.shown = shown;
  markOpen(parts, version);
  parts.contract.append(element("p", { text: "Asking for the contract …" }));
  try {
    const { contract, drift } = await parts.askContract(name, version);
    if (parts.shown !== shown) return; // closed, or another one asked for, meanwhile
    const { node, showDrift } = showContract(contract);
    shown.showDrift = showDrift;
    showDrift(drift);
    parts.contract.replaceChildren(node);
  } catch (error) {
    if (parts.shown === shown) parts.contract.replaceChildren(element("p", { class: "warning", text: error.message }));
  }
}

function closeContract(parts) {
  if (parts.shown === null) return;
  parts.shown = null;
  parts.contract.replaceChildren();
  markOpen(parts, null);
}

function markOpen(parts, version) {
  for (const row of parts.versions.body.children) {
    const open = row.firstChild.textContent === version;
    row.querySelector("button").setAttribute("aria-expanded", String(open));
  }
}
