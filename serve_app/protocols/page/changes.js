// Differences of two listings of what runs, in words.

import { clip } from "./dom.js";
import { sayCanary } from "./policies.js";

/** Return sentences for what differs between two listings. */
export function changesBetween(before, after) {
  if (before === null) return [];
  const sentences = [];
  const policies = new Map(before.policies.map((policy) => [policy.name, policy]));
  for (const now of after.policies) {
    const then = policies.get(now.name);
    policies.delete(now.name);
    if (then === undefined) sentences.push(`${now.name} is served, version ${now.version}`);
    else sentences.push(...changesOf(then, now).map((sentence) => `${now.name}: ${sentence}`));
  }
  return [...sentences, ...[...policies.keys()].map((name) => `${name} is no longer served`)];
}

function changesOf(then, now) {
  const sentences = [];
  const [froms, tos] = [then, now].map(({ aliases }) => new Map(Object.entries(aliases)));
  for (const alias of new Set([...froms.keys(), ...tos.keys()])) {
    const [from, to] = [froms.get(alias), tos.get(alias)];
    if (from === to) continue;
    const before = from === undefined ? "" : ` (before: ${from})`;
    sentences.push(to === undefined ? `${alias} is gone` : `${alias} leads to version ${to}${before}`);
  }
  const states = new Map(then.version_states.map(({ version, state }) => [version, state]));
  for (const { version, state, reason } of now.version_states) {
    const why = reason && `: ${clip(reason, 300)}`;
    if (states.get(version) !== state) sentences.push(`version ${version} is ${state}${why}`);
    states.delete(version);
  }
  for (const version of states.keys()) sentences.push(`version ${version} is unloaded`);
  if (JSON.stringify(then.canary) !== JSON.stringify(now.canary)) {
    sentences.push(now.canary ? `canary: ${sayCanary(now.canary)}` : "the canary has ended");
  }
  if (then.shadow?.version !== now.shadow?.version) {
    sentences.push(now.shadow ? `version ${now.shadow.version} computes along` : "the shadow has ended");
  }
  return sentences;
}
