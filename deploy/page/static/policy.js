// The exported graph in onnxruntime-web: one observation at a time, with its memory, and the golden values.

import * as ort from "./lib/onnxruntime.js";

const ARRAYS = {
  float32: Float32Array, float64: Float64Array, int8: Int8Array, uint8: Uint8Array, int16: Int16Array,
  uint16: Uint16Array, int32: Int32Array, uint32: Uint32Array, int64: BigInt64Array, uint64: BigUint64Array,
  bool: Uint8Array,
};

// What `read` makes of a file of the page, which comes from the server each time it has changed.
export async function fetched(path, read) {
  try {
    const reply = await fetch(path, { cache: "no-cache" });
    if (!reply.ok) throw new Error(`${reply.status} ${reply.statusText}`);
    return await read(reply);
  } catch (error) {
    throw new Error(`${path} cannot be fetched: ${error.message || error}`);
  }
}

// WebAssembly that is packed with gzip; some servers unpack it on the way.
export function wasm(path) {
  return fetched(path, async reply => {
    const content = await reply.arrayBuffer();
    if (new Uint8Array(content)[0] !== 0x1f) return content;
    return new Response(new Blob([content]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  });
}

export class Policy {
  static async load(folder) {
    const [facts, data, graph, binary] = await Promise.all([
      fetched(`${folder}/facts.json`, reply => reply.json()),
      fetched(`${folder}/data.bin`, reply => reply.arrayBuffer()),
      fetched(`${folder}/policy.onnx`, reply => reply.arrayBuffer()),
      wasm("lib/onnxruntime.wasm.gz"),
    ]);
    Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: binary });
    ort.env.logLevel = "error";
    const session = await ort.InferenceSession.create(new Uint8Array(graph), { executionProviders: ["wasm"] });
    return new Policy(facts, data, session);
  }

  constructor(facts, data, session) {
    Object.assign(this, { facts, data, session });
    this.reset();
  }

  // Begin an episode: the memory is its initial value.
  reset() {
    this.state = {};
    for (const { name, dtype, shape, initial } of this.facts.state) {
      const value = array(dtype, product(shape));
      if (Array.isArray(initial)) value.set(initial.map(number => cast(dtype, number)));
      else value.fill(cast(dtype, initial));
      this.state[`state_in.${name}`] = value;
    }
  }

  // The numbers of an array that Python put into data.bin.
  read({ dtype, shape, offset }) {
    return new ARRAYS[dtype](this.data, offset, product(shape));
  }

  // The outputs for an observation (numbers by input, or of the only one); the memory moves on. An action outside its
  // space is an error, as in Python.
  async outputs(observation) {
    const given = ArrayBuffer.isView(observation) ? { obs: observation } : observation;
    const feeds = {};
    for (const { name, dtype, shape } of this.facts.inputs) {
      const size = [1, ...shape.slice(1)], value = this.state[name] ?? given[name] ?? array(dtype, product(size));
      feeds[name] = new ort.Tensor(dtype, value, size);
    }
    const outputs = await this.session.run(feeds);
    for (const { name } of this.facts.state) this.state[`state_in.${name}`] = outputs[`state_out.${name}`].data;
    for (const [name, { bounds: [low, high] }] of Object.entries(this.facts.action)) {
      outputs[name].data.forEach((given, index) => {
        const value = Number(given), least = low[index] ?? -Infinity, most = high[index] ?? Infinity;
        if (!(value >= least && value <= most)) throw new Error(`${name} ${index} is ${value}: outside ${least} to ${most}`);
      });
    }
    return outputs;
  }

  async act(observation) {
    return (await this.outputs(observation)).action.data;
  }

  // Compute the golden values: the largest difference, how many samples there are, and the output that is wrong.
  async golden() {
    const { inputs, outputs, rtol, atol } = this.facts.golden, feeds = {};
    for (const { name, dtype } of this.facts.inputs) {
      feeds[name] = new ort.Tensor(dtype, this.read(inputs[name]), inputs[name].shape);
    }
    const computed = await this.session.run(feeds);
    let largest = 0, fault = "";
    for (const [name, place] of Object.entries(outputs)) {
      const got = computed[name].data, exact = !place.dtype.startsWith("float");
      this.read(place).forEach((wanted, index) => {
        const [a, b] = [Number(got[index]), Number(wanted)], same = Object.is(a, b) || a === b;
        const difference = same ? 0 : Math.abs(a - b);
        largest = Math.max(largest, difference); // NaN stays
        if (!(difference <= (exact ? 0 : rtol * Math.abs(b) + atol))) fault ||= name;
      });
      if (got.length !== product(place.shape)) fault ||= name;
    }
    const samples = Math.min(...this.facts.outputs.map(({ name }) => outputs[name]?.shape[0] ?? 0));
    return { largest, samples, fault: fault || (samples ? "" : "nothing to compare with") };
  }
}

export function array(dtype, size) {
  return new ARRAYS[dtype](size);
}

export function cast(dtype, number) {
  return dtype.endsWith("int64") ? BigInt(Math.round(number)) : number;
}

function product(shape) {
  return shape.reduce((all, size) => all * size, 1);
}
