// The robots of rlservo.envs on MuJoCo's WebAssembly build: commands, physics, observations, endings.
// Every number comes from Python (robot_facts.py), and `proof` replays Python's own episodes.

const WXYZ = "wxyz", XYZ = "xyz";

class Robot {
  constructor(mujoco, facts) {
    this.mujoco = mujoco;
    this.facts = facts;
    this.model = mujoco.MjModel.from_xml_string(facts.xml);
    this.model.opt.timestep = facts.timestep;
    this.data = new mujoco.MjData(this.model);
    this.targetMocap = this.model.body_mocapid[this.model.body(facts.target_body).id];
  }

  // Begin an episode: the robot at rest at start.qpos, the target [m] in MuJoCo's world.
  place(start) {
    const { mujoco, model, data } = this;
    mujoco.mj_resetData(model, data);
    data.qpos.set(start.qpos);
    if (data.act.length) data.act.set(start.qpos);
    this.start = start;
    this.steps = 0;
    this.setUp(start);
    this.moveTarget(start.target);
    mujoco.mj_forward(model, data);
    this.collided = data.ncon > 0;
  }

  moveTarget(position) {
    this.target = [...position];
    this.data.mocap_pos.set(position, 3 * this.targetMocap);
    this.mujoco.mj_kinematics(this.model, this.data);
  }

  observe() {
    return Float32Array.from(this.facts.observation, element => this.read(element));
  }

  // One control cycle after `command`; `step` is a physics step of it.
  advance() {
    for (let count = 0; count < this.facts.substeps; count++) this.step();
    this.endCycle();
  }

  status() {
    return this.judge() ?? (this.steps >= this.facts.max_steps ? this.facts.time_limit_status : null);
  }
}

class Arm extends Robot {
  constructor(mujoco, facts) {
    super(mujoco, facts);
    this.servo = facts.actuators.map(name => this.model.actuator(name).id);
    this.feedForward = facts.actuators.map(name => this.model.actuator(`${name}_velocity`).id);
    this.tool = this.model.site(facts.tool).id;
  }

  setUp(start) {
    this.remaining = 0; // physics steps until the trajectory arrives
    this.velocity = start.qpos.map(() => 0);
    this.fixed = start.qpos.map((_, joint) => {
      const name = this.facts.joints[joint];
      const element = this.facts.observation.find(one => one.quantity === "joint position" && one.joint === name);
      return (start.qpos[joint] - element.offset) / element.scale;
    });
    this.last = this.previous = start.qpos.map(() => 0);
  }

  // rlservo.robots.ur.simulation: a trajectory in which all joints arrive together.
  command(action) {
    const { joints, max_velocity, min_trajectory_s, timestep } = this.facts;
    const goal = [...this.start.qpos], command = [...this.fixed];
    this.facts.action.forEach(({ joint, scale, offset }, index) => {
      goal[joints.indexOf(joint)] = action[index] * scale + offset;
      command[joints.indexOf(joint)] = action[index];
    });
    const way = goal.map((value, joint) => value - this.data.act[joint]);
    const time = Math.max(min_trajectory_s, ...way.map((value, joint) => Math.abs(value) / max_velocity[joint]));
    this.remaining = Math.max(1, Math.ceil(time / timestep - 1e-9));
    this.velocity = way.map(value => value / (this.remaining * timestep));
    [this.previous, this.last] = [this.last, command];
    this.steps++;
  }

  step() {
    const { data } = this, ctrl = data.ctrl, moves = this.remaining > 0;
    this.velocity.forEach((value, joint) => {
      ctrl[this.servo[joint]] = ctrl[this.feedForward[joint]] = moves ? value : 0;
    });
    if (moves) this.remaining--;
    this.mujoco.mj_step(this.model, data);
    if (data.ncon) this.collided = true;
  }

  endCycle() { // mj_step leaves the poses of its start
    this.mujoco.mj_kinematics(this.model, this.data);
  }

  hold() {
    this.data.act.set(this.data.qpos);
    this.remaining = 0;
  }

  read({ name, quantity, joint, axis, scale, offset }) {
    const { data, facts } = this, index = facts.joints.indexOf(joint);
    switch (quantity) {
      case "joint position": return (data.qpos[index] - offset) / scale;
      case "joint velocity": return data.qvel[index];
      case "last action": return (name.endsWith("_previous_action") ? this.previous : this.last)[index];
      case "quaternion": return this.start.quaternion[WXYZ.indexOf(axis)];
      case "position": return this.inBase(name.startsWith("ee_") ? this.robotPosition() : this.target)[XYZ.indexOf(axis)];
    }
    return this.polar()[["target_r", "target_theta", "target_phi"].indexOf(name)];
  }

  inBase(position) {
    return position.map((value, axis) => value - this.facts.base[axis]);
  }

  robotPosition() {
    return [...this.data.site_xpos.subarray(3 * this.tool, 3 * this.tool + 3)];
  }

  toolAxes() { // row-major, the axes are columns
    return this.data.site_xmat.subarray(9 * this.tool, 9 * this.tool + 9);
  }

  polar() { // of the target, in the tool's frame
    const tool = this.robotPosition(), way = this.target.map((value, axis) => value - tool[axis]), axes = this.toolAxes();
    const [x, y, z] = [0, 1, 2].map(axis => way[0] * axes[axis] + way[1] * axes[3 + axis] + way[2] * axes[6 + axis]);
    const r = Math.hypot(x, y, z);
    return [r, r > 0 ? Math.acos(Math.max(-1, Math.min(1, z / r))) : 0, Math.atan2(y, x)];
  }

  distance() {
    return this.polar()[0];
  }

  angle() { // of the tool from the target's orientation
    const axes = this.toolAxes(), wanted = rotation(this.start.quaternion);
    const cosine = 0.5 * (wanted.reduce((sum, value, index) => sum + value * axes[index], 0) - 1);
    return Math.acos(Math.max(-1, Math.min(1, cosine)));
  }

  judge() {
    const { within, within_angle } = this.facts;
    if (this.collided) return "collision";
    return this.distance() <= within && (within_angle === null || this.angle() < within_angle) ? "success" : null;
  }
}

class Base extends Robot {
  constructor(mujoco, facts) {
    super(mujoco, facts);
    this.cubeMocaps = facts.cube_bodies.map(name => this.model.body_mocapid[this.model.body(name).id]);
    this.body = this.model.body("base_link").id;
    this.noise = facts.laser_noise; // [m], 0 in the proof
    const groups = [0, 0, 0, 0, 0, 0];
    groups[facts.beam_group] = 1;
    this.groups = groups;
    this.buffers = facts.scanners.map(({ angles }) => [
      new mujoco.IntBuffer(angles.length), new mujoco.DoubleBuffer(angles.length),
    ]);
  }

  setUp(start) {
    this.setpoint = [0, 0]; // [m/s], [rad/s]
    this.asked = [0, 0];
    this.age = 0;
    this.cubes = [];
    start.cubes.forEach((cube, index) => this.moveObstacle(index, cube));
  }

  moveObstacle(index, [x, y, yaw]) {
    const mocap = this.cubeMocaps[index];
    this.cubes[index] = [x, y, yaw];
    this.data.mocap_pos.set([x, y], 3 * mocap);
    this.data.mocap_quat.set([Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)], 4 * mocap);
    this.mujoco.mj_kinematics(this.model, this.data);
    this.readings = null;
  }

  command(action) {
    const { limits, action: elements, safety_distance } = this.facts;
    const blocked = this.scan() && this.nearest < safety_distance;
    this.asked = limits.map((limit, index) =>
      blocked ? 0 : Math.max(-limit, Math.min(limit, action[index] * elements[index].scale)));
    this.age = 0;
    this.steps++;
  }

  step() {
    const { increments, timeout, timestep } = this.facts, { data } = this;
    if (this.age++ >= timeout) this.asked = [0, 0];
    this.setpoint = this.setpoint.map((value, index) => {
      const most = increments[index];
      return value + Math.max(-most, Math.min(most, this.asked[index] - value));
    });
    const [linear, angular] = this.setpoint;
    data.ctrl.set([linear, linear * angular * timestep / 2, angular]);
    this.mujoco.mj_step(this.model, data);
    this.touched ||= data.ncon > 0;
    this.readings = null;
  }

  endCycle() {
    this.mujoco.mj_kinematics(this.model, this.data);
    this.mujoco.mj_collision(this.model, this.data);
    this.collided = this.touched || this.data.ncon > 0;
    this.touched = false;
  }

  hold() {
    this.asked = [0, 0];
  }

  robotPosition() {
    return [this.data.qpos[0], this.data.qpos[1], 0];
  }

  distance() {
    return Math.hypot(this.target[0] - this.data.qpos[0], this.target[1] - this.data.qpos[1]);
  }

  read({ name }) {
    const [x, y, yaw] = this.data.qpos, [vx, vy, turn] = this.data.qvel;
    const fixed = this.steps % this.facts.fix_interval === 0;
    switch (name) {
      case "target_r": return fixed ? this.distance() : 0;
      case "target_theta": return fixed ? wrapped(Math.atan2(this.target[1] - y, this.target[0] - x) - yaw) : 0;
      case "linear_velocity": return vx * Math.cos(yaw) + vy * Math.sin(yaw);
      case "angular_velocity": return turn;
    }
    return this.scan()[this.facts.observed_beams[Number(name.slice("laser_".length))]];
  }

  // rlservo.robots.mir100.lasers: readings [m] of both scanners, and `ends`, where the beams end in the world.
  scan() {
    if (this.readings || !this.facts.cube_bodies.length) return this.readings;
    const [least, most] = this.facts.laser_range, [x, y, yaw] = this.data.qpos;
    this.readings = [];
    this.ends = [];
    this.nearest = most;
    this.facts.scanners.forEach(({ position: [ahead, left, height], angles }, index) => {
      const origin = [
        x + Math.cos(yaw) * ahead - Math.sin(yaw) * left, y + Math.sin(yaw) * ahead + Math.cos(yaw) * left, height,
      ];
      const directions = angles.flatMap(angle => [
        Math.cos(angle) * Math.cos(yaw) - Math.sin(angle) * Math.sin(yaw),
        Math.cos(angle) * Math.sin(yaw) + Math.sin(angle) * Math.cos(yaw), 0,
      ]);
      const [geoms, distances] = this.buffers[index];
      this.mujoco.mj_multiRay(
        this.model, this.data, origin, directions, this.groups, true, this.body, geoms, distances, null, angles.length,
        most);
      distances.GetView().forEach((distance, beam) => {
        const missed = distance < 0, true_distance = missed ? most : distance;
        this.nearest = Math.min(this.nearest, true_distance);
        const reading = missed ? most : Math.max(least, Math.min(most, true_distance + this.noise * normal()));
        this.readings.push(reading);
        this.ends.push([origin, origin.map((value, axis) => value + reading * directions[3 * beam + axis])]);
      });
    });
    return this.readings;
  }

  judge() {
    const { boundary, min_reading, within } = this.facts, [x, y] = this.data.qpos;
    if (this.distance() < within) return "success"; // outweighs a failure, as in robo-gym
    if (boundary !== null) return Math.abs(x) > boundary || y > boundary ? "out of boundary" : null;
    return this.collided || Math.min(...this.scan()) < min_reading || this.cornerIsNearACube() ? "collision" : null;
  }

  cornerIsNearACube() {
    const [x, y, yaw] = this.data.qpos, cos = Math.cos(yaw), sin = Math.sin(yaw);
    return this.cubes.some(([cubeX, cubeY]) => {
      const dx = cubeX - x, dy = cubeY - y, ahead = cos * dx + sin * dy, left = cos * dy - sin * dx;
      return this.facts.corners.some(([a, l]) => (ahead - a) ** 2 + (left - l) ** 2 <= this.facts.safety_radius ** 2);
    });
  }
}

export function makeRobot(mujoco, facts) {
  return new { arm: Arm, base: Base }[facts.kind](mujoco, facts);
}

// Drive Python's recorded episodes again: this simulation, this policy. Return the largest difference of an observation,
// in its own unit, and what was wrong first, if anything was.
export async function proof(robot, policy, episodes, bound) {
  const noise = robot.noise, found = { largest: 0, steps: 0, fault: "" };
  robot.noise = 0;
  for (const episode of episodes) {
    const recorded = policy.read(episode.observations), [rows, size] = episode.observations.shape;
    robot.place(episode);
    policy.reset();
    for (let row = 0; row < rows; row++) {
      const observation = robot.observe();
      observation.forEach((value, index) => {
        const difference = Math.abs(value - recorded[row * size + index]);
        found.largest = Math.max(found.largest, difference); // NaN stays
        if (!(difference <= bound)) found.fault ||= robot.facts.observation[index].name;
      });
      const status = row ? robot.status() : null, expected = row === rows - 1 ? episode.status : null;
      if (status !== expected) found.fault ||= `the ending (${status} instead of ${expected})`;
      if (found.fault || expected) break;
      robot.command(await policy.act(observation));
      robot.advance();
      found.steps++;
    }
  }
  robot.noise = noise;
  if (!found.steps) found.fault ||= "nothing to compare with";
  return found;
}

function rotation([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

function wrapped(angle) { // as Python's %
  const turn = 2 * Math.PI, shifted = (angle + Math.PI) % turn;
  return (shifted < 0 ? shifted + turn : shifted) - Math.PI;
}

function normal() {
  return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
}
