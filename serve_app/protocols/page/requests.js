// Requests of the page to its server: one at a time, with one key, kept in a variable here and nowhere else.

import { clip } from "./dom.js";

const TIMEOUT_MS = 8000;

let key = null;

/** Ask with this key from now on; null is none. */
export function useKey(given) {
  key = given;
}

/** Return whether a key is in use. */
export function hasKey() {
  return key !== null;
}

/** No answer (status 0), or one that is not a success, with the server's sentence. */
export class NoSuccess extends Error {
  constructor(status, sentence) {
    super(sentence);
    this.status = status;
  }
}

let last = Promise.resolve();

/** Ask for a path when everything asked before is answered. */
export function ask(path) {
  const answer = last.then(() => send(path));
  last = answer.catch(() => {});
  return answer;
}

async function send(path) {
  const [reply, text] = await receive(path).catch(() => {
    throw new NoSuccess(0, "");
  });
  if (!reply.ok) throw new NoSuccess(reply.status, sentenceOf(text) ?? `status ${reply.status}`);
  return text;
}

async function receive(path) {
  const reply = await fetch(path, {
    headers: key === null ? {} : { authorization: `Bearer ${key}` },
    mode: "same-origin",
    credentials: "omit",
    cache: "no-store",
    redirect: "error",
    referrerPolicy: "no-referrer",
    signal: AbortSignal.timeout(TIMEOUT_MS),
  });
  return [reply, await reply.text()];
}

function sentenceOf(text) {
  try {
    return clip(JSON.parse(text).error, 500);
  } catch {
    return null; // what stands before the server answered
  }
}
