// The page: loads a policy, proves it, and lets it act on its robot or on the observation that a person sets.

import { cardElements, element } from "./card.js";
import { Policy, array, cast, fetched, wasm } from "./policy.js";
import { makeRobot, proof } from "./robots.js";

const SIMD = [0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11];
const DWELL_S = 1.5; // after an episode's end
const FIELDS = 96; // elements of an observation that are shown one by one
const at = id => document.getElementById(id);
const show = (text, kind = "") => Object.assign(at("status"), { textContent: text, className: kind });

main().catch(fail);

function fail(error) {
  show(String(error?.message ?? error), "bad");
  document.body.dataset.state = "broken";
}

async function main() {
  if (!WebAssembly.validate(new Uint8Array(SIMD)) || !window.DecompressionStream) {
    throw new Error("This browser is too old: the page needs WebAssembly with SIMD and DecompressionStream (2023).");
  }
  const { policies } = await fetched("policies.json", reply => reply.json());
  const name = decodeURIComponent(location.hash.slice(1)), chosen = policies.find(one => one.name === name || !name);
  addEventListener("hashchange", () => location.reload());
  if (policies.length > 1) {
    at("policies").append(...policies.map(one => {
      const link = element("a", one.name, { href: `#${encodeURIComponent(one.name)}` });
      if (one === chosen) link.ariaCurrent = "page";
      return link;
    }));
  }
  if (!chosen) throw new Error(`This page has no policy ${name}.`);
  document.title = at("name").textContent = `${chosen.name} ${chosen.version}`;
  show("Loading …");
  const policy = await Policy.load(`policies/${encodeURIComponent(chosen.name)}`);
  at("card").append(...cardElements(policy.facts.card));
  const golden = await policy.golden();
  const proven = prove(golden, `golden values: ${golden.samples} samples`, tolerance(policy.facts.golden));
  const robot = policy.facts.robot && await loadRobot(policy);
  const same = !robot || await proveRobot(robot, policy);
  const actions = showActions(policy);
  at("proof-title").textContent = proven && same ? "Proven in this browser" : "Not proven in this browser";
  if (!proven || !same) throw new Error("Not proven in this browser, so nothing moves.");
  policy.reset();
  if (robot) await drive(robot, policy, actions);
  else await ask(policy, actions);
}

function prove({ largest, fault }, what, allowed) {
  const line = element("li", `${what}: largest difference ${exponent(largest)} (allowed ${allowed})`);
  line.className = fault ? "bad" : "good";
  if (fault) line.append(` – differs: ${fault}`);
  at("proofs").append(line);
  return !fault;
}

function exponent(number) {
  return number.toExponential(1).replace(".0", "").replace("-", "−");
}

function tolerance({ rtol, atol }) {
  return `${exponent(rtol)} of the value + ${exponent(atol)}`;
}

async function loadRobot(policy) {
  const [{ default: load }, wasmBinary] = await Promise.all([import("./lib/mujoco.js"), wasm("lib/mujoco.wasm.gz")]);
  return makeRobot(await load({ wasmBinary }), policy.facts.robot);
}

async function proveRobot(robot, policy) {
  show("Comparing with Python …");
  const { starts, bound } = robot.facts, episodes = starts.filter(start => start.observations);
  const found = await proof(robot, policy, episodes, bound);
  return prove(found, `simulation: ${episodes.length} of Python's episodes, ${found.steps} steps with this policy`, exponent(bound));
}

// -- actions

function showActions(policy) {
  const lines = [], isOurs = Boolean(policy.facts.robot); // whose scaled actions are rad, m/s and rad/s
  for (const [name, { elements, bounds: [low, high] }] of Object.entries(policy.facts.action)) {
    low.forEach((least, index) => {
      const { name: label = low.length > 1 ? `${name} ${index}` : name, unit = "", quantity = "", scale, offset } = elements[index] ?? {};
      const line = element("div", "", { className: "bar" }), value = element("output");
      const most = high[index], meter = element("meter", "", { min: least ?? -1, max: most ?? 1 });
      meter.ariaLabel = readable(label, isOurs);
      line.append(element("span", meter.ariaLabel), meter, value);
      at("action").append(line);
      lines.push(outputs => {
        if (!outputs) return void (value.textContent = "–", meter.removeAttribute("value"));
        const number = Number(outputs[name].data[index]);
        meter.value = number;
        value.textContent = isOurs && scale !== null
          ? `${rounded(number * scale + (offset ?? 0))} ${{ "linear velocity": "m/s", "angular velocity": "rad/s" }[quantity] ?? "rad"}`
          : `${rounded(number)} ${unit === "1" ? "" : unit}`;
      });
    });
  }
  return outputs => lines.forEach(line => line(outputs)); // null: there is no action
}

function readable(label, scaled = false) {
  return (scaled ? label.replace("_normalized", "") : label).replaceAll("_", " ");
}

function rounded(number) {
  return Number.isInteger(number) ? String(number) : number.toFixed(Math.abs(number) < 100 ? 2 : 0);
}

// -- a robot

async function drive(robot, policy, showAction) {
  const { facts } = robot, { starts, substeps, timestep } = facts, reach = reachOf(facts);
  let phase = "driving", next = 0, endedAt = 0, tick = 0, owed = 0, byHand = false, before = performance.now(), share = 1;
  const begin = start => {
    robot.place(start);
    policy.reset();
    [phase, tick] = ["driving", 0];
  };
  const here = target => ({
    ...robot.start, qpos: [...robot.data.qpos], target, cubes: robot.cubes ?? [],
  });
  const nextTarget = () => {
    const away = start => Math.hypot(...start.target.map((value, axis) => value - robot.robotPosition()[axis]));
    do next = (next + 1) % starts.length; while (away(starts[next]) < 3 * facts.within);
    begin(phase === "failed" ? starts[next] : { ...here(starts[next].target), quaternion: starts[next].quaternion });
  };
  const stage = await openStage(robot, (index, position) => {
    at("hint").hidden = byHand = true;
    if (index >= 0) robot.moveObstacle(index, [position[0], position[1], robot.cubes[index][2]]);
    else robot.moveTarget(reach(position));
    if (phase === "arrived" && robot.judge() !== "success") begin(here(robot.target));
  });
  let paused = false;
  at("pause").onclick = () => at("pause").textContent = (paused = !paused) ? "Go on" : "Pause";
  at("next").onclick = () => { byHand = false; nextTarget(); };
  at("controls").hidden = at("now").hidden = false;
  begin(starts[0]);
  stage?.draw();
  globalThis.rlservo = { robot, policy, stage }; // for the console
  document.body.dataset.state = "running";
  for (;;) {
    const now = await new Promise(requestAnimationFrame);
    const due = (paused || phase === "failed" ? 0 : owed) + (now - before) / 1000;
    owed = Math.min(due, 0.1);
    share += 0.1 * (due ? owed / due - share : 0);
    before = now;
    for (; !paused && phase !== "failed" && owed >= timestep; owed -= timestep) {
      if (tick === 0 && phase === "driving") {
        const outputs = await policy.outputs(robot.observe());
        robot.command(outputs.action.data);
        showAction(outputs);
      }
      robot.step();
      if (++tick < substeps) continue;
      tick = 0;
      robot.endCycle();
      const status = phase === "driving" && robot.status();
      if (status) {
        [phase, endedAt] = [status === "success" ? "arrived" : "failed", now];
        robot.hold();
        show(phase === "arrived" ? `Arrived after ${(robot.steps * substeps * timestep).toFixed(1)} s` : status.replaceAll("_", " "),
          phase === "arrived" ? "good" : "bad");
      } else if (phase === "driving") show("On its way");
    }
    if (!paused && phase !== "driving" && now - endedAt > 1000 * DWELL_S && !(byHand && phase === "arrived")) nextTarget();
    showNow(robot, share);
    stage?.draw();
  }
}

async function openStage(robot, moved) {
  try {
    const { Stage } = await import("./stage.js"), stage = new Stage(at("canvas"), robot, moved);
    Object.assign(at("hint"), { hidden: false, textContent: "Drag the target; drag elsewhere to look around" });
    document.body.classList.add("drawn");
    return stage;
  } catch (error) {
    Object.assign(at("hint"), { hidden: false, textContent: "No WebGL here, so no picture: the numbers are live." });
    console.info(String(error));
    return null;
  }
}

// Where a target may be dragged: the box of the environment's own targets, not farther out than the farthest of them.
function reachOf({ starts, base = [0, 0, 0], kind }) {
  const targets = starts.map(start => start.target);
  const far = position => Math.hypot(...position.map((value, axis) => value - base[axis]));
  const most = Math.max(...targets.map(far));
  return position => {
    const boxed = position.map((value, axis) => {
      const all = targets.map(target => target[axis]);
      return Math.max(Math.min(...all), Math.min(Math.max(...all), value));
    });
    const share = Math.min(1, most / far(boxed));
    return kind === "arm" ? boxed.map((value, axis) => base[axis] + share * (value - base[axis])) : boxed;
  };
}

function showNow(robot, share) {
  const lines = { "to the target": `${robot.distance().toFixed(2)} m`, steps: `${robot.steps} of ${robot.facts.max_steps}` };
  if (share < 0.9) lines["slow browser"] = `${Math.round(100 * share)}% of real time`;
  at("now").replaceChildren(...Object.entries(lines).flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
}

// -- any other policy: fields for its observation

function bounded(bound) { // a slider cannot be set between Box's largest floats
  return Math.abs(bound ?? Infinity) < 1e6 ? bound : null;
}

async function ask(policy, showAction) {
  const { facts } = policy, observation = {}, fields = [];
  const samples = policy.facts.golden.inputs[Object.keys(facts.observation)[0]].shape[0];
  for (const { name, dtype, shape } of facts.inputs) {
    if (!facts.observation[name]) continue;
    observation[name] = array(dtype, shape.slice(1).reduce((all, size) => all * size, 1));
    const { elements, bounds: [low, high] } = facts.observation[name], seen = policy.read(facts.golden.inputs[name]);
    if (observation[name].length > FIELDS) {
      at("fields").append(element("p", `${name}: ${shape.slice(1).join("x")} numbers, those of the sample`));
      continue;
    }
    observation[name].forEach((_, index) => {
      const column = [...seen].filter((_, place) => place % observation[name].length === index).map(Number);
      const most = bounded(high[index]) ?? Math.max(...column), least = bounded(low[index]) ?? Math.min(...column);
      const whole = !dtype.startsWith("float");
      const label = element("label", "", { className: "field" }), value = element("output");
      const slider = element("input", "", { type: "range", min: least, max: Math.max(most, least + (whole ? 1 : 1e-3)), step: whole ? 1 : "any" });
      const known = elements[index] ?? { name: observation[name].length > 1 ? `${name} ${index}` : name, unit: "" };
      label.append(element("span", readable(known.name)), slider, value);
      at("fields").append(label);
      const unit = known.unit === "1" ? "" : known.unit;
      fields.push(() => {
        slider.value = Number(observation[name][index]);
        value.textContent = `${rounded(Number(observation[name][index]))} ${unit}`;
      });
      slider.oninput = () => {
        observation[name][index] = cast(dtype, Number(slider.value));
        update();
      };
    });
  }
  const acting = !facts.state.length ? "Acting on the observation below"
    : `Acting at ${facts.rate ? "its rate" : "10 Hz (its own rate is not known)"}, with its memory`;
  let busy = false, again = false;
  const update = async () => {
    fields.forEach(field => field());
    if (busy) return void (again = true);
    busy = true;
    do {
      again = false;
      await policy.outputs(observation).then(
        outputs => (showAction(outputs), show(acting, "good")), error => (showAction(null), show(error.message, "bad")));
    } while (again);
    busy = false;
  };
  const pick = element("input", "", { type: "number", min: 1, max: samples, value: 1 });
  const take = () => {
    const row = Math.max(1, Math.min(samples, Math.round(pick.valueAsNumber || 1))) - 1;
    for (const [name, value] of Object.entries(observation)) {
      const all = policy.read(facts.golden.inputs[name]);
      value.set(all.subarray((row % (all.length / value.length)) * value.length, (row % (all.length / value.length) + 1) * value.length));
    }
    return update();
  };
  pick.onchange = take;
  const label = element("label", "Golden sample ");
  label.append(pick, ` of ${samples}`);
  at("samples").append(label);
  if (facts.state.length) {
    const reset = element("button", "Forget", { type: "button", onclick: () => { policy.reset(); update(); } });
    at("samples").append(reset);
    setInterval(() => busy || update(), 1000 / (facts.rate ?? 10));
  }
  at("inputs").hidden = false;
  document.body.classList.add("asked");
  await take();
  document.body.dataset.state = "running";
}
