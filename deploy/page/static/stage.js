// The robot's scene in three.js: every visible geom of the MuJoCo model, a target to drag, laser beams.

import * as THREE from "./lib/three.module.js";
import { OrbitControls } from "./lib/OrbitControls.js";

const VISIBLE_GROUPS = 3; // MuJoCo's viewers show the geom groups 0 to 2
const EVERY_BEAM = 6; // of the laser's, one that is drawn
const UP = new THREE.Vector3(0, 0, 1);

export class Stage {
  // `moved(index, position)`: the target (index -1) or an obstacle was dragged there.
  constructor(canvas, robot, moved) {
    this.canvas = canvas;
    this.robot = robot;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    this.camera.up.copy(UP);
    const { position, lookat } = robot.facts.camera;
    this.camera.position.fromArray(position);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.target.fromArray(lookat);
    Object.assign(this.controls, { enableDamping: true, maxPolarAngle: 0.52 * Math.PI, minDistance: 0.5, maxDistance: 16 });
    this.light(lookat);
    this.bodies = this.build();
    this.target = this.bodies[robot.model.body(robot.facts.target_body).id];
    this.obstacles = (robot.facts.cube_bodies ?? []).map(name => this.bodies[robot.model.body(name).id]);
    this.handle = new THREE.Mesh(new THREE.SphereGeometry(robot.facts.kind === "arm" ? 0.11 : 0.3));
    this.handle.visible = false;
    this.target.add(this.handle);
    if (this.obstacles.length) this.addBeams();
    this.listen(moved);
  }

  light(lookat) {
    const sun = new THREE.DirectionalLight(0xffffff, 2.2), wide = this.robot.facts.kind === "arm" ? 1.6 : 6;
    sun.position.set(lookat[0] + 1.5, lookat[1] - 1.5, lookat[2] + 4);
    sun.target.position.fromArray(lookat);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.radius = 4;
    sun.shadow.bias = -0.0005;
    Object.assign(sun.shadow.camera, { left: -wide, right: wide, top: wide, bottom: -wide, near: 0.1, far: 12 });
    const sky = new THREE.HemisphereLight(0xffffff, 0x9aa4b0, 1.7);
    sky.position.copy(UP);
    this.scene.add(sun, sun.target, sky);
  }

  build() {
    const { model } = this.robot, bodies = [];
    for (let body = 0; body < model.nbody; body++) this.scene.add(bodies[body] = new THREE.Group());
    for (let geom = 0; geom < model.ngeom; geom++) {
      if (model.geom_group[geom] >= VISIBLE_GROUPS) continue;
      const mesh = shape(model, geom);
      mesh.position.fromArray(model.geom_pos, 3 * geom);
      turn(mesh.quaternion, model.geom_quat, geom);
      bodies[model.geom_bodyid[geom]].add(mesh);
    }
    return bodies;
  }

  addBeams() {
    this.beams = new THREE.LineSegments(
      new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0xe5484d, transparent: true, opacity: 0.2 }));
    this.beams.frustumCulled = false;
    this.scene.add(this.beams);
  }

  listen(moved) {
    const ray = new THREE.Raycaster(), plane = new THREE.Plane(), where = new THREE.Vector3(), { canvas } = this;
    let dragged = null;
    const aim = event => {
      const box = canvas.getBoundingClientRect();
      ray.setFromCamera(new THREE.Vector2(
        2 * (event.clientX - box.left) / box.width - 1, 1 - 2 * (event.clientY - box.top) / box.height), this.camera);
    };
    const things = () => [this.handle, ...this.obstacles];
    const thingAt = event => {
      aim(event);
      const hit = ray.intersectObjects(things(), true)[0]?.object;
      return hit ? things().findIndex(thing => thing === hit || thing.children.includes(hit)) : -1;
    };
    canvas.addEventListener("pointerdown", event => {
      const index = thingAt(event);
      if (index < 0) return;
      const from = index ? this.obstacles[index - 1].position : this.target.position;
      const normal = this.robot.facts.kind === "arm" ? this.camera.getWorldDirection(new THREE.Vector3()) : UP;
      plane.setFromNormalAndCoplanarPoint(normal, from);
      const grip = ray.ray.intersectPlane(plane, where)?.clone().sub(from) ?? new THREE.Vector3();
      dragged = { index: index - 1, grip };
      this.controls.enabled = false;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", event => {
      if (!dragged) return void (canvas.style.cursor = event.buttons || thingAt(event) < 0 ? "" : "grab");
      aim(event);
      if (ray.ray.intersectPlane(plane, where)) moved(dragged.index, where.sub(dragged.grip).toArray());
    });
    const drop = () => {
      dragged = null;
      this.controls.enabled = true;
    };
    canvas.addEventListener("pointerup", drop);
    canvas.addEventListener("pointercancel", drop);
  }

  draw() {
    const { data } = this.robot, { clientWidth: width, clientHeight: height } = this.canvas;
    this.bodies.forEach((body, index) => {
      body.position.fromArray(data.xpos, 3 * index);
      turn(body.quaternion, data.xquat, index);
    });
    if (this.beams && this.robot.scan()) {
      const ends = this.robot.ends.filter((_, index) => index % EVERY_BEAM === 0).flat(2);
      this.beams.geometry.setAttribute("position", new THREE.Float32BufferAttribute(ends, 3));
    }
    if (this.size !== `${width} ${height}`) {
      this.size = `${width} ${height}`;
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      // What is seen across a square is seen across a narrow screen as well.
      this.camera.fov = width < height ? 2 * Math.atan(Math.tan(Math.PI / 9) * height / width) * 180 / Math.PI : 40;
      this.camera.updateProjectionMatrix();
    }
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

function shape(model, geom) {
  const [x, y, z] = model.geom_size.subarray(3 * geom, 3 * geom + 3), type = model.geom_type[geom];
  const material = model.geom_matid[geom];
  const [red, green, blue, alpha] = material < 0
    ? model.geom_rgba.subarray(4 * geom, 4 * geom + 4) : model.mat_rgba.subarray(4 * material, 4 * material + 4);
  if (type === 0) return floor();
  const geometry = {
    2: () => new THREE.SphereGeometry(x, 32, 24),
    3: () => new THREE.CapsuleGeometry(x, 2 * y, 12, 32).rotateX(Math.PI / 2),
    5: () => new THREE.CylinderGeometry(x, x, 2 * y, 40).rotateX(Math.PI / 2),
    6: () => new THREE.BoxGeometry(2 * x, 2 * y, 2 * z),
    7: () => meshGeometry(model, model.geom_dataid[geom]),
  }[type]();
  const mesh = new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({
    color: new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace), roughness: 0.55, metalness: 0.05,
    transparent: alpha < 1, opacity: alpha, depthWrite: alpha === 1,
    emissive: material >= 0 ? new THREE.Color(red, green, blue).multiplyScalar(model.mat_emission[material]) : 0,
  }));
  mesh.castShadow = mesh.receiveShadow = alpha === 1;
  return mesh;
}

function meshGeometry(model, mesh) {
  const [first, count] = [model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]];
  const [face, faces] = [model.mesh_faceadr[mesh], model.mesh_facenum[mesh]];
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute(
    "position", new THREE.Float32BufferAttribute(model.mesh_vert.slice(3 * first, 3 * (first + count)), 3));
  geometry.setIndex([...model.mesh_face.subarray(3 * face, 3 * (face + faces))]);
  geometry.computeVertexNormals();
  return geometry;
}

// A grid of half metres that fades out, on which shadows fall.
function floor() {
  const [ground, line] = matchMedia("(prefers-color-scheme: dark)").matches ? ["#39424c", "#505b67"] : ["#aab4be", "#8d98a4"];
  const paint = (size, draw) => {
    const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
    draw(canvas.getContext("2d"));
    return new THREE.CanvasTexture(canvas);
  };
  const radius = 7;
  const lines = paint(128, context => {
    context.fillStyle = ground;
    context.fillRect(0, 0, 128, 128);
    context.strokeStyle = line;
    context.lineWidth = 2;
    context.strokeRect(0, 0, 128, 128);
  });
  lines.wrapS = lines.wrapT = THREE.RepeatWrapping;
  lines.repeat.set(4 * radius, 4 * radius);
  lines.anisotropy = 8;
  const fade = paint(256, context => {
    const gradient = context.createRadialGradient(128, 128, 0, 128, 128, 128);
    gradient.addColorStop(0.15, "#fff");
    gradient.addColorStop(1, "#000");
    context.fillStyle = gradient;
    context.fillRect(0, 0, 256, 256);
  });
  const mesh = new THREE.Mesh(
    new THREE.CircleGeometry(radius, 64),
    new THREE.MeshStandardMaterial({ map: lines, alphaMap: fade, transparent: true, roughness: 1 }));
  mesh.receiveShadow = true;
  return mesh;
}

function turn(quaternion, wxyz, index) {
  quaternion.set(wxyz[4 * index + 1], wxyz[4 * index + 2], wxyz[4 * index + 3], wxyz[4 * index]);
}
