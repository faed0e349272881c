// The policies on the page: a section for each, with its charts, its versions and an open contract.

import { bar, chart, timeTicks } from "./chart.js";
import { isFar, showContract } from "./contract.js";
import { clip, element, keep, labelCells, number, setText, showFacts, table } from "./dom.js";
import { driftOf } from "./metrics.js";

const PRODUCTION = "production";
const COLUMNS = ["Version", "State", "Aliases", "Requests", "Per second", "Share"];
COLUMNS.push("Failures", "Latency p50 / p99", "Drift", "Contract");
const NUMBERS = new Set(["Requests", "Per second", "Share", "Latency p50 / p99"]);
const KEPT_S = 900; // of the curves
const SHORTEST_S = 60;
const QUIET = "No requests yet: their rate, their latency and the drift of observations appear with the first.";
const MOST_DRIFTS = 6;
const DRIFT_SCALE = 3; // [standard deviations]

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
  const parts = {
    description: element("p", { class: "given note" }),
    facts: element("dl", { class: "facts" }),
    requests: chart("Requests [1/s]", ["answered", "failed"], "The curves begin with the next look.", 1),
    latency: chart("Latency [ms]", ["p50", "p99"], "p50 and p99 over time appear with the next request."),
    success: chart("Success by version [%]", ["newest"], "", 100),
    successText: element("p", { class: "note" }),
    drift: element("ul"),
    driftText: element("p", { class: "note" }),
    quiet: element("p", { class: "note", text: QUIET }),
    charts: element("div", { class: "charts" }),
    looks: [], // [time, answered a second, failed a second, p50, p99]
    versions: table(`Versions of ${name}`, COLUMNS),
    contract: element("div", { id: `${id}-contract` }),
    shown: null, // {version, showDrift} of the open contract
    askContract,
  };
  parts.success.figure.append(parts.successText);
  const title = element("figcaption", {}, element("strong", { text: "Drift by element [σ of the training]" }));
  parts.charts.append(
    ...[parts.requests, parts.latency, parts.success].map(({ figure }) => figure),
    element("figure", { class: "drift" }, title, parts.drift, parts.driftText),
  );
  const section = element(
    "section",
    { class: "policy", "aria-labelledby": id },
    element("h2", { id, text: name }),
    parts.description,
    parts.facts,
    parts.quiet,
    parts.charts,
    parts.versions.region,
    parts.contract,
  );
  sections.set(section, parts);
  return section;
}

function updateSection(parts, policy, looks, at) {
  setText(parts.description, clip(policy.description));
  showFacts(parts.facts, factsOf(policy, looks));
  parts.quiet.hidden = looks.total("rlservo_requests_total", { policy: policy.name }) > 0;
  parts.charts.hidden = !parts.quiet.hidden;
  drawLooks(parts, policy.name, looks, at);
  drawSuccess(parts, successes(policy.name, looks));
  showDrifts(parts, { policy: policy.name, version: policy.version }, looks);
  keep(
    parts.versions.body,
    policy.version_states,
    ({ version }) => version,
    ({ version }) => makeRow(parts, policy.name, version),
    (row, status) => updateRow(row, policy, status, looks),
  );
  labelCells(parts.versions.region);
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
    ["Sessions", saySessions(count)],
  ];
}

function saySessions(count) {
  const [kept, begun, lost] = ["", "_begun_total", "_lost_total"].map((kind) => count(`rlservo_sessions${kind}`));
  return begun + lost > 0 ? `${kept} kept, ${begun} begun, ${lost} requests for unknown ones` : "";
}

/** Return a canary in words. */
export function sayCanary({ version, share }) {
  return `version ${version} gets ${number(100 * share)}% of the sessions`;
}

function compared({ name, shadow }, looks) {
  const wanted = { policy: name, shadow: shadow.version };
  const count = looks.total("rlservo_shadow_difference_count", wanted);
  const missed = looks.total("rlservo_shadow_missed_total", wanted);
  if (count === 0) return `nothing is compared yet, ${missed} missed`;
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
  const codes = looks.totalBy("rlservo_requests_total", "code", wanted);
  codes.delete("ok");
  const failures = [...codes].filter(([, count]) => count > 0);
  const latency = looks.quantiles("rlservo_request_seconds", wanted, [0.5, 0.99]);
  const drift = driftOf(looks.newest, wanted);
  const [[total], [rate]] = ["total", "rate"].map((by) => looks.requests(by, wanted));
  const [all] = looks.requests("rate", { policy: policy.name });
  const texts = [
    sayStates(status),
    status.aliases.join(", "),
    count(total),
    number(rate, 3),
    all ? `${number((100 * rate) / all, 2)}%` : "–",
    failures.map(([code, times]) => `${code}\u00a0${count(times)}`).join(", ") || "0",
    sayLatency(latency),
    sayDrift(drift, looks, wanted),
  ];
  texts.forEach((text, index) => setText(row.children[index + 1], text));
  row.classList.toggle("in-use", status.version === policy.version);
  row.classList.toggle("failed", status.state === "failed");
  row.children[6].classList.toggle("far", failures.length > 0);
  row.children[8].classList.toggle("far", drift !== null && [...drift.values()].some(isFar));
}

function sayStates({ states, reason }) {
  const counts = [...new Set(states)].map((state) => [state, states.filter((each) => each === state).length]);
  const every = counts.length === 1 ? states[0] : counts.map(([state, times]) => `${state} on ${times}`).join(", ");
  return every + (reason && `: ${clip(reason, 500)}`);
}

/** Return a median and a high quantile in words. */
export function sayLatency({ quantiles: [median, high], recent }) {
  if (median === null) return "–";
  const ms = (seconds) => (Number.isFinite(seconds) ? number(1e3 * seconds, 2) : "over 1000");
  return `${ms(median)} / ${ms(high)} ms${recent ? "" : ", earlier"}`;
}

function sayDrift(drift, looks, wanted) {
  if (drift === null) {
    const measured = looks.has("rlservo_observation_looks_total", wanted);
    return measured ? "nothing seen yet" : "no filter to compare with";
  }
  const [[name, { shift }]] = drift;
  const far = [...drift.values()].filter(isFar).length;
  return `${far > 0 ? `${far} of ${drift.size} far; ` : ""}most ${number(shift, 2)} σ: ${clip(name, 60)}`;
}

function count(value) {
  return Math.round(value).toLocaleString("en");
}

function drawLooks(parts, policy, looks, at) {
  const { recent, quantiles } = looks.quantiles("rlservo_request_seconds", { policy }, [0.5, 0.99]);
  const times = quantiles.map((seconds) => (recent ? 1000 * Math.min(seconds, 1) : null)); // the last bound is 1 s
  parts.looks.push([at, ...looks.requests("rate", { policy }), ...times]);
  parts.looks = parts.looks.filter(([time]) => time >= at - KEPT_S);
  const from = Math.min(parts.looks[0][0], at - SHORTEST_S);
  const rows = (...columns) => parts.looks.map((row) => columns.map((column) => row[column]));
  parts.requests.draw(rows(0, 1, 2), from, at, timeTicks(from, at));
  parts.latency.draw(rows(0, 3, 4), from, at, timeTicks(from, at));
}

function showDrifts({ drift, driftText }, wanted, looks) {
  const all = [...(driftOf(looks.newest, wanted) ?? [])];
  drift.parentElement.hidden = !looks.has("rlservo_observation_looks_total", wanted); // no filter to compare with
  keep(
    drift,
    all.slice(0, MOST_DRIFTS),
    ([name]) => name,
    ([name]) => element("li", {}, element("span", { text: clip(name, 60) }), bar(0, 1), element("strong")),
    (item, [, now]) => {
      item.classList.toggle("far", isFar(now));
      item.children[1].replaceWith(bar(now.shift, DRIFT_SCALE));
      setText(item.lastChild, number(now.shift, 2));
    },
  );
  const far = all.filter(([, now]) => isFar(now)).length;
  const some = `Version ${wanted.version}: ${far} of ${all.length} are far; its contract shows all.`;
  setText(driftText, all.length > 0 ? some : "What drifts most appears after some requests.");
}

/** Return [version, episodes that ended, share of success], the oldest version first, also of those unloaded since. */
function successes(policy, looks) {
  const ends = "rlservo_episode_ends_total";
  const good = looks.totalBy(ends, "version", { policy, outcome: "success" });
  return [...looks.totalBy(ends, "version", { policy })]
    .filter(([, count]) => count > 0)
    .sort(([a], [b]) => a.localeCompare(b, "en", { numeric: true }))
    .map(([version, count]) => [version, count, (good.get(version) ?? 0) / count]);
}

function drawSuccess({ success, successText }, all) {
  success.figure.hidden = all.length === 0;
  if (all.length === 0) return;
  const rows = all.map(([, , share], at) => [at, 100 * share]);
  success.draw(rows, -0.5, all.length - 0.5, all.map(([version], at) => [at, version]));
  const say = ([version, episodes, share]) => `${number(100 * share, 3)}% of ${count(episodes)} with ${version}`;
  const ends = all.length > 1 ? [all[0], all.at(-1)] : all;
  setText(successText, `Episodes that succeeded, by version: ${ends.map(say).join(", … ")}`);
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
