// What runs on the server that this page is from, asked again and again.
//
// Each answer of `/v1/policies` and `/metrics` is one replica's, so the page keeps what each replica said last.

import { changesBetween } from "./changes.js";
import { clip, element, keep, setText, showFacts } from "./dom.js";
import { driftOf, Looks, parse } from "./metrics.js";
import { showPolicies } from "./policies.js";
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
    awaySince = new Date();
    note("the server does not answer");
  } else {
    delayMs = Math.min(2 * delayMs, SLOWEST_MS);
  }
  const why = error.message && ` (${error.message})`;
  setText(byId("state"), `No answer since ${clock(awaySince)}${why}. This page goes on asking.`);
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
  for (const id of ["policies", "warnings", "changes", "server-facts"]) keep(byId(id), [], () => null, () => null);
  byId("changes").replaceChildren();
  for (const id of ["server", "history", "key-used"]) byId(id).hidden = true;
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
  for (const sentence of changesBetween(shown, listing)) note(sentence);
  shown = listing;
  showPolicies(byId("policies"), listing, { looks, askContract, at });
  const warnings = warningsOf(listing);
  keep(
    byId("warnings"),
    warnings,
    (text) => text,
    (text) => element("li", { class: "warning given", text }),
  );
  showFacts(byId("server-facts"), factsOf(listing));
  byId("server").hidden = false;
  const what = `${listing.policies.length} ${listing.policies.length === 1 ? "policy" : "policies"}`;
  setText(byId("state"), `${what} served. Asked again every ${EVERY_MS / 1000} seconds.`);
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

function factsOf({ generation, changed_at: changedAt, changed_by: changedBy }) {
  const replicas = looks.replicas.filter(Boolean);
  const refusals = [...looks.totalBy("rlservo_requests_total", "code", { version: "" })];
  const several = "the figures are the sum of what these said within the last minute, each since its start";
  const change = changedAt && `${new Date(changedAt).toLocaleString()}: ${clip(changedBy ?? "", 200)}`;
  const waited = looks.newest.map((samples) => samples.get("rlservo_queue_longest")?.[0]?.value ?? 0);
  return [
    ["Replicas that answered", replicas.length > 1 ? `${replicas.join(", ")}; ${several}` : replicas.join("")],
    ["Last change", change && `${change} (plan ${generation})`],
    ["Refused before a version was chosen", refusals.map(([code, count]) => `${code} ${count}`).join(", ")],
    ["Most requests that waited at once", String(Math.max(0, ...waited))],
    ["Not counted", "what a proxy refuses before a replica sees it"],
    ["Last answer", clock(new Date())],
  ];
}

function note(sentence) {
  const time = element("time", { text: clock(new Date()) });
  byId("history").hidden = false;
  byId("changes").prepend(element("li", { class: "given" }, time, ` ${sentence}`));
  while (byId("changes").children.length > MOST_CHANGES) byId("changes").lastChild.remove();
}

function clock(date) {
  return date.toLocaleTimeString([], { hour12: false });
}

byId("key-form").addEventListener("submit", takeKey);
byId("forget").addEventListener("click", () => askForKey(""));
document.addEventListener("visibilitychange", () => {
  listings.clear(); // a server that was started anew meanwhile counts its changes from 1 again
  refresh();
});
refresh();
