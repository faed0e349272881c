// What runs on the server that this page is from, asked again and again.
//
// Each answer of `/v1/policies` and `/metrics` is one replica's, so the page keeps what each replica said last.

import { changesBetween } from "./changes.js";
import { clip, element, keep, number, setText, showFacts, stamp } from "./dom.js";
import { driftOf, Looks, parse } from "./metrics.js";
import { sayLatency, showPolicies } from "./policies.js";
import { ask, hasKey, NoSuccess, useKey } from "./requests.js";

const EVERY_MS = 2000;
const SLOWEST_MS = 10000; // between attempts, while there is no answer
const WINDOW_S = 20; // of rates and latencies
const KEPT_S = 60; // of what a replica said
const MOST_CHANGES = 50;
const MISSING = "not there";
const STATES = ["failed", "loading", MISSING, "ready"]; // of several replicas the first of these is the version's

const byId = (id) => document.getElementById(id);

let epoch = 0; // counts the keys: what was asked with an earlier one is not shown
let timer = 0;
let busy = false;
let wantsKey = false;
let delayMs = EVERY_MS;
let awaySince = null;
let shown = null; // the listing on the page
let opened = 0; // the plan that was followed when the page began to note changes
const listings = new Map(); // replica -> {at, listing}
const looks = new Looks(WINDOW_S, KEPT_S);

/** Ask once, show what came, and have it done again. */
async function refresh() {
  clearTimeout(timer);
  if (busy || wantsKey || document.hidden) return;
  busy = true;
  const mine = epoch;
  try {
    const answers = await askAll();
    if (mine === epoch) succeed(...answers);
  } catch (error) {
    if (mine === epoch) fail(error);
  } finally {
    busy = false;
    timer = setTimeout(refresh, mine === epoch ? delayMs : 0);
  }
}

async function askAll() {
  // In either order: a proxy that takes turns would else ask one replica for all lists, another for all metrics.
  const paths = ["v1/policies", "metrics"];
  if (Math.random() < 0.5) paths.reverse();
  const texts = {};
  for (const path of paths) texts[path] = await ask(path);
  return [JSON.parse(texts["v1/policies"]), parse(texts.metrics)];
}

function succeed(listing, samples) {
  const at = Date.now() / 1000; // and not `performance.now()`, which stands still while a computer sleeps
  if (awaySince !== null) {
    forget(); // it may have been started anew: its changes are counted from 1 again
    note("the server answers again");
  }
  awaySince = null;
  delayMs = EVERY_MS;
  listings.set(listing.replica, { at, listing });
  for (const [replica, { at: then }] of listings) if (then < at - KEPT_S) listings.delete(replica);
  looks.add(samples, at);
  show(newest(), at);
}

function fail(error) {
  if (error.status === 401 || error.status === 403) {
    askForKey(hasKey() ? `The server refused the key: ${error.message}.` : "");
    return;
  }
  if (!(error instanceof NoSuccess)) {
    setText(byId("state"), `This page cannot show what the server answers: ${error.message}`);
    throw error;
  }
  if (awaySince === null) {
    awaySince = Date.now() / 1000;
    note("the server does not answer");
  } else {
    delayMs = Math.min(2 * delayMs, SLOWEST_MS);
  }
  const why = error.message && ` (${error.message})`;
  setText(byId("state"), `No answer since ${stamp(awaySince)}${why}. This page goes on asking.`);
  document.title = "rlservo: no answer";
  document.body.className = "away";
}

/** Forget what replicas said; what is on the page stays until there is something newer. */
function forget() {
  listings.clear();
  looks.clear();
}

// Keys.

function askForKey(why) {
  wantsKey = true;
  clear();
  setText(byId("state"), "This server requires an API key.");
  setText(byId("key-error"), why);
  byId("key-form").hidden = false;
  byId("key").focus();
  document.title = "rlservo: API key?";
}

/** Take everything off the page that a key has opened, and the key. */
function clear() {
  useKey(null);
  epoch += 1;
  shown = null;
  forget();
  awaySince = null;
  delayMs = EVERY_MS;
  for (const id of ["policies", "warnings", "now", "past", "server-facts"]) keep(byId(id), []);
  byId("changes").replaceChildren();
  for (const id of ["history", "key-used"]) byId(id).hidden = true;
  document.body.className = "";
}

function takeKey(event) {
  event.preventDefault();
  const typed = byId("key").value.trim();
  byId("key").value = "";
  if (!/^[\x21-\x7e]+$/.test(typed)) {
    setText(byId("key-error"), typed === "" ? "Type a key first." : "A key has no spaces and no special letters.");
    return;
  }
  useKey(typed);
  epoch += 1;
  wantsKey = false;
  setText(byId("key-error"), "");
  setText(byId("state"), "Asking the server …");
  byId("key-form").hidden = true;
  byId("policies").focus();
  refresh();
}

// What came.

/** Return the listing of the replica that has followed the most changes, each version with its states on all. */
function newest() {
  const all = [...listings.values()].sort((a, b) => b.listing.generation - a.listing.generation || b.at - a.at);
  const stateOn = ({ listing }, name, version) => {
    const policy = listing.policies.find((each) => each.name === name);
    return policy?.version_states.find((each) => each.version === version)?.state ?? MISSING;
  };
  const policies = all[0].listing.policies.map((policy) => ({
    ...policy,
    version_states: policy.version_states.map((status) => {
      const states = all.map((replica) => stateOn(replica, policy.name, status.version));
      return { ...status, states, state: STATES.find((state) => states.includes(state)) ?? status.state };
    }),
  }));
  return { ...all[0].listing, policies };
}

function show(listing, at) {
  document.body.className = "";
  byId("key-form").hidden = true;
  byId("key-used").hidden = !hasKey();
  for (const sentence of changesBetween(shown, listing)) note(`${sentence}; ${sayPlan(listing)}`);
  if (shown === null) opened = listing.generation;
  shown = listing;
  showPolicies(byId("policies"), listing, { looks, askContract, at });
  keep(
    byId("warnings"),
    warningsOf(listing),
    (text) => text,
    (text) => element("li", { class: "warning given", text }),
  );
  showFacts(byId("now"), figures());
  byId("now").className = looks.requests("rate")[1] > 0 ? "failing" : "";
  showFacts(byId("server-facts"), facts());
  showPast(listing);
  byId("history").hidden = false;
  const what = `${listing.policies.length} ${listing.policies.length === 1 ? "policy" : "policies"}`;
  setText(byId("state"), `${what} served`);
  document.title = `rlservo: ${what}`;
}

async function askContract(name, version) {
  const mine = epoch;
  const text = await ask(`v1/policies/${encodeURIComponent(name)}/versions/${encodeURIComponent(version)}`);
  if (mine !== epoch) throw new Error("the key has been changed meanwhile");
  return { contract: JSON.parse(text), drift: driftOf(looks.newest, { policy: name, version }) };
}

function warningsOf({ behind }) {
  const warnings = [...behind];
  if (new Set([...listings.values()].map(({ listing }) => listing.generation)).size > 1) {
    warnings.push("Not every replica has followed the last change yet.");
  }
  if (looks.newest.some((samples) => samples.get("rlservo_api_keys_current")?.some(({ value }) => value === 0))) {
    warnings.push("The API keys' file cannot be used: the keys it held before are still accepted.");
  }
  return warnings.map((text) => clip(text, 1000));
}

/** Return the state of the whole server, in one line. */
function figures() {
  const uptimes = looks.newest.map((samples) => samples.get("rlservo_uptime_seconds")?.[0]?.value ?? 0);
  const [answered, failed] = looks.requests("rate");
  return [
    ["Server", location.host],
    ["Up", sayDuration(Math.min(...uptimes))],
    ["Requests", `${number(answered, 3)} /s`],
    ["Latency p50 / p99", sayLatency(looks.quantiles("rlservo_request_seconds", {}, [0.5, 0.99]))],
    ["Errors", `${number(failed, 2)} /s, ${looks.requests("total")[1]} in all`],
    ["Sessions", String(looks.total("rlservo_sessions"))],
  ];
}

function sayDuration(seconds) {
  const days = Math.floor(seconds / 86400);
  return `${days > 0 ? `${days} d ` : ""}${new Date(1000 * seconds).toISOString().slice(11, 19)}`;
}

function facts() {
  const replicas = looks.replicas.filter(Boolean);
  const several = "the figures are the sum of what these said within the last minute, each since its start";
  const refusals = [...looks.totalBy("rlservo_requests_total", "code", { version: "" })];
  return [
    ["Replicas that answered", replicas.length > 1 ? `${replicas.join(", ")}; ${several}` : replicas.join("")],
    ["Refused before a version was chosen", refusals.map(([code, count]) => `${code} ${count}`).join(", ")],
    ["Not counted", replicas.length > 1 ? "what a proxy refuses before a replica sees it" : ""],
    ["Last answer", stamp(Date.now() / 1000)],
  ];
}

// What has changed.

function sayPlan({ generation, changed_by: by }) {
  return `plan ${generation}${by ? `, ${clip(by, 200)}` : ""}`;
}

/** Show what the server itself says of its past. */
function showPast({ policies, ...plan }) {
  const events = policies.flatMap(({ name, version_states: versions }) =>
    versions.map(({ version, loaded_at: at }) => [at, `${name}: version ${version} loaded`]),
  );
  for (const before of plan.recent) {
    if (before.generation <= opened) events.push([before.changed_at, sayPlan(before)]);
  }
  const known = events.filter(([at]) => at).sort(([a], [b]) => (a < b ? 1 : -1));
  keep(byId("past"), known, String, ([at, sentence]) => entry(at, sentence));
}

function entry(at, sentence) {
  return element("li", { class: "given" }, element("time", { text: stamp(at) }), ` ${sentence}`);
}

function note(sentence) {
  byId("history").hidden = false;
  byId("changes").prepend(entry(Date.now() / 1000, sentence));
  while (byId("changes").children.length > MOST_CHANGES) byId("changes").lastChild.remove();
}

byId("key-form").addEventListener("submit", takeKey);
byId("forget").addEventListener("click", () => askForKey(""));
document.addEventListener("visibilitychange", () => {
  listings.clear(); // a server that was started anew meanwhile counts its changes from 1 again
  refresh();
});
refresh();
