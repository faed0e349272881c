// Prometheus' text, and what a page makes of two looks at it: rates, quantiles, drift.
// Format: https://prometheus.io/docs/instrumenting/exposition_formats/

const SAMPLE = /^([A-Za-z_:][\w:]*)(?:\{(.*)\})? (\S+)$/s;
const LABEL = /([A-Za-z_]\w*)="((?:[^"\\]|\\.)*)",?/gsy;
const ESCAPED = { n: "\n", "\\": "\\", '"': '"' };

/** Return the samples of a text, by name: lists of {labels, value}. */
export function parse(text) {
  const samples = new Map();
  for (const line of text.split("\n")) {
    const [, name, labels = "", value] = SAMPLE.exec(line) ?? [];
    if (name === undefined) continue; // a comment, or nothing
    push(samples, name, { labels: labelsOf(labels), value: numberOf(value) });
  }
  return samples;
}

function push(lists, key, item) {
  lists.set(key, lists.get(key) ?? []);
  lists.get(key).push(item);
}

function labelsOf(text) {
  const pairs = [...text.matchAll(LABEL)];
  return new Map(pairs.map(([, name, value]) => [name, value.replace(/\\(.)/g, (_, c) => ESCAPED[c] ?? c)]));
}

function numberOf(text) {
  return Number(text.replace(/^([+-]?)Inf$/, "$1Infinity"));
}

/** Return a family's samples whose labels are these. */
export function select(samples, name, wanted = {}) {
  const pairs = Object.entries(wanted);
  return (samples.get(name) ?? []).filter(({ labels }) => pairs.every(([key, value]) => labels.get(key) === value));
}

/** Return the sum of such samples. */
export function sum(samples, name, wanted) {
  return select(samples, name, wanted).reduce((total, { value }) => total + value, 0);
}

/** Return such samples summed by one label. */
export function sumBy(samples, name, label, wanted) {
  return merge(select(samples, name, wanted).map(({ labels, value }) => [[labels.get(label) ?? "", value]]));
}

/** Return the samples of each replica in a text's. */
function byReplica(samples) {
  const replicas = new Map();
  for (const [name, all] of samples) {
    for (const sample of all) {
      const replica = sample.labels.get("replica") ?? "";
      if (!replicas.has(replica)) replicas.set(replica, new Map());
      push(replicas.get(replica), name, sample);
    }
  }
  return replicas;
}

/** Looks at the metrics of several replicas, of which each answer holds one's, or those of a server's workers. */
export class Looks {
  #replicas = new Map(); // replica -> looks, the oldest first
  #windowS;
  #keptS;

  /** Rates are over `windowS`; a replica that has not answered for `keptS` is forgotten. */
  constructor(windowS, keptS) {
    this.#windowS = windowS;
    this.#keptS = keptS;
  }

  /** Add an answer's samples, seen at a time in seconds. */
  add(answer, at) {
    for (const [replica, samples] of byReplica(answer)) {
      const looks = this.#replicas.get(replica) ?? [];
      looks.push({ at, samples });
      // One look at least as old as the window stays, to compare with.
      while (looks.length > 2 && looks[1].at <= at - this.#windowS) looks.shift();
      while (looks[0].at < at - this.#keptS) looks.shift();
      this.#replicas.set(replica, looks);
    }
    for (const [name, others] of this.#replicas) if (others.at(-1).at < at - this.#keptS) this.#replicas.delete(name);
  }

  /** Forget everything. */
  clear() {
    this.#replicas.clear();
  }

  /** Return the replicas' names. */
  get replicas() {
    return [...this.#replicas.keys()];
  }

  /** Return the newest samples of each replica. */
  get newest() {
    return [...this.#replicas.values()].map((looks) => looks.at(-1).samples);
  }

  /** Return the sum over all replicas, since their start. */
  total(name, wanted) {
    return this.newest.reduce((total, samples) => total + sum(samples, name, wanted), 0);
  }

  /** Return whether a replica tells of such a sample at all. */
  has(name, wanted) {
    return this.newest.some((samples) => select(samples, name, wanted).length > 0);
  }

  /** Return sums by one label over all replicas, since their start. */
  totalBy(name, label, wanted) {
    return merge(this.newest.map((samples) => sumBy(samples, name, label, wanted)));
  }

  /** Return how much a counter has grown a second, over the window; null before there are two looks. */
  rate(name, wanted) {
    let rate = null;
    for (const [first, last] of this.#windows()) {
      const grown = sum(last.samples, name, wanted) - sum(first.samples, name, wanted);
      rate = (rate ?? 0) + Math.max(grown, 0) / (last.at - first.at);
    }
    return rate;
  }

  /** Return how many requests were answered and how many failed, by `rate` or `total`. */
  requests(by, wanted = {}) {
    const [all, answered] = [wanted, { ...wanted, code: "ok" }].map((each) => this[by]("rlservo_requests_total", each));
    return [answered, all === null ? null : Math.max(all - answered, 0)];
  }

  /** Return a histogram's quantiles: of the window (`recent`) or, where nothing was counted in it, since the start. */
  quantiles(name, wanted, shares) {
    const bucket = `${name}_bucket`;
    const grown = [...this.#windows()].map(([first, last]) => {
      const before = sumBy(first.samples, bucket, "le", wanted);
      const now = sumBy(last.samples, bucket, "le", wanted);
      return new Map([...now].map(([bound, count]) => [bound, Math.max(count - (before.get(bound) ?? 0), 0)]));
    });
    const recent = merge(grown);
    const isRecent = (recent.get("+Inf") ?? 0) > 0;
    const counts = isRecent ? recent : this.totalBy(bucket, "le", wanted);
    return { recent: isRecent, quantiles: shares.map((share) => quantile(counts, share)) };
  }

  *#windows() {
    for (const looks of this.#replicas.values()) {
      if (looks.length > 1 && looks.at(-1).at > looks[0].at) yield [looks[0], looks.at(-1)];
    }
  }
}

function merge(maps) {
  const all = new Map();
  for (const map of maps) for (const [key, value] of map) all.set(key, (all.get(key) ?? 0) + value);
  return all;
}

/** Return a quantile of cumulative counts by upper bound, as Prometheus' `histogram_quantile` does: null of none. */
export function quantile(counts, share) {
  const buckets = [...counts].map(([bound, count]) => [numberOf(bound), count]).sort(([a], [b]) => a - b);
  const total = buckets.at(-1)?.[1] ?? 0;
  if (total === 0) return null;
  let [low, below] = [0, 0];
  for (const [bound, count] of buckets) {
    if (count >= share * total) {
      if (bound === Infinity) return Infinity;
      return low + ((bound - low) * (share * total - below)) / (count - below || 1);
    }
    [low, below] = [bound, count];
  }
  return Infinity;
}

/** Return drift by element, {shift, spread}, the furthest first, of the replica that moved furthest; null without. */
export function driftOf(newest, wanted) {
  const further = ([, a], [, b]) => Math.abs(b.shift) - Math.abs(a.shift);
  const found = newest.map((samples) => {
    const spreads = sumBy(samples, "rlservo_observation_spread", "element", wanted);
    const shifts = sumBy(samples, "rlservo_observation_shift", "element", wanted);
    return [...shifts].map(([name, shift]) => [name, { shift, spread: spreads.get(name) ?? NaN }]).sort(further);
  });
  const [furthest] = found.filter(({ length }) => length > 0).sort(([a], [b]) => further(a, b));
  return furthest ? new Map(furthest) : null;
}
