// The 3-D view: tubes, paths, drones, and what the drone in focus senses.

const UP = new THREE.Vector3(0, 0, 1);
const LAYERS = { path: "path", axis: "centreline", rays: "LiDAR", cone: "camera", target: "target" };
const FOLLOW_DISTANCE = 5; // over R
const SPOT = `
uniform vec3 colour;
uniform float size, ring;
void main() {
  float r = length(gl_PointCoord - 0.5) * 2.0;
  float edge = 2.0 / size;
  float alpha = 1.0 - smoothstep(1.0 - edge, 1.0, r);
  if (ring > 0.5) alpha *= smoothstep(0.55 - edge, 0.55, r) + smoothstep(0.40, 0.40 - edge, r);
  if (alpha < 0.02) discard;
  gl_FragColor = vec4(colour, alpha);
  #include <colorspace_fragment>
}`;

/** Round points of a size in pixels, which no distance makes smaller. */
function spots(count, size, ring = false) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
  const pixels = size * Math.min(window.devicePixelRatio, 2);
  const material = new THREE.ShaderMaterial({
    uniforms: { colour: { value: new THREE.Color() }, size: { value: pixels }, ring: { value: ring ? 1 : 0 } },
    vertexShader: `uniform float size; void main() {
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); gl_PointSize = size; }`,
    fragmentShader: SPOT, transparent: true, depthWrite: false,
  });
  const points = new THREE.Points(geometry, material);
  points.frustumCulled = false;
  return points;
}

/** Thin lines between pairs of points that move. */
function segments(count, opacity) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * count), 3));
  const material = new THREE.LineBasicMaterial({ transparent: true, opacity, depthWrite: false });
  const lines = new THREE.LineSegments(geometry, material);
  lines.frustumCulled = false;
  return lines;
}

/** A line of a width in pixels along points (3 N), with a colour a point where `colours` is given. */
function ribbon(points, width, opacity, colours = null) {
  const count = Math.max(points.length / 3 - 1, 1);
  const pairs = (values) => {
    const out = new Float32Array(6 * count);
    for (let i = 0; i < count; i++) {
      const next = Math.min(3 * i + 3, values.length - 3);
      out.set(values.subarray(3 * i, 3 * i + 3), 6 * i);
      out.set(values.subarray(next, next + 3), 6 * i + 3);
    }
    return out;
  };
  const geometry = new THREE.LineSegmentsGeometry();
  geometry.setPositions(pairs(points));
  if (colours) geometry.setColors(pairs(colours));
  const material = new THREE.LineMaterial({ linewidth: width, transparent: opacity < 1, opacity, vertexColors: !!colours });
  const line = new THREE.LineSegments2(geometry, material);
  line.frustumCulled = false;
  return line;
}

function vectorAt(array, i, into) {
  return into.set(array[3 * i], array[3 * i + 1], array[3 * i + 2]);
}

/** One run in the view: its path and its drone. */
class RunView {
  constructor(run) {
    this.run = run;
    this.group = new THREE.Group();
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.BufferAttribute(run.drone.vertices, 3));
    shape.setIndex(new THREE.BufferAttribute(run.drone.faces, 1));
    shape.computeVertexNormals();
    this.drone = new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ roughness: 0.55, metalness: 0.0 }));
    this.spot = spots(1, 15, true);
    this.group.add(this.drone, this.spot);
    this.path = this.ghost = null;
    this._next = new THREE.Vector3();
    this._turn = new THREE.Quaternion();
  }

  /** Draw the path anew in these colours (3 N). */
  colour(colours) {
    for (const line of [this.path, this.ghost]) {
      if (!line) continue;
      this.group.remove(line);
      line.geometry.dispose();
      line.material.dispose();
    }
    this.path = ribbon(this.run.series.position, 3.5, 1, colours);
    this.ghost = ribbon(this.run.series.position, 2, 0.35, colours);
    this.group.add(this.ghost, this.path);
  }

  place(record, part) {
    const { position, quaternion } = this.run.series;
    vectorAt(position, record, this.drone.position);
    this.drone.quaternion.fromArray(quaternion, 4 * record);
    if (part > 0) {
      this.drone.position.lerp(vectorAt(position, record + 1, this._next), part);
      this.drone.quaternion.slerp(this._turn.fromArray(quaternion, 4 * record + 4), part);
    }
    this.spot.position.copy(this.drone.position);
    this.path.geometry.instanceCount = record;
    this.path.visible = record > 0;
  }
}

/** What the drone in focus senses: LiDAR, the camera's pyramid, target and memory. */
class SensesView {
  constructor(rays) {
    this.rays = segments(2 * rays, 0.5);
    this.hits = spots(2 * rays, 4);
    this.cone = segments(8, 0.85);
    this.sight = segments(1, 0.9);
    this.target = spots(1, 13);
    this.memory = ribbon(new Float32Array(6), 4, 1);
    this.group = new THREE.Group();
    this.group.add(this.rays, this.hits, this.cone, this.sight, this.target, this.memory);
    this.axes = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
  }

  paint() {
    const set = (object, name) => (object.material.uniforms?.colour?.value ?? object.material.color).set(cssColour(name));
    set(this.rays, "--ray");
    set(this.hits, "--ray");
    set(this.cone, "--cone");
    set(this.memory, "--memory");
    this.seen = new THREE.Color(cssColour("--good"));
    this.unseen = new THREE.Color(cssColour("--faint"));
  }

  /** Show what `run` senses at a record with its drone at this place. */
  update(run, record, drone, layers) {
    const [forward, up, right] = this.axes;
    forward.set(1, 0, 0).applyQuaternion(drone.quaternion);
    up.set(0, 0, 1).applyQuaternion(drone.quaternion);
    right.crossVectors(forward, up);
    this.rays.visible = this.hits.visible = layers.rays;
    if (layers.rays) this._scan(run, record, drone.position);
    this.cone.visible = layers.cone;
    if (layers.cone) this._pyramid(run, record, drone.position);
    this._aim(run, record, drone.position, layers.target);
  }

  _scan(run, record, centre) {
    const { rays, offset, reach } = run.lidar, [forward, up, right] = this.axes;
    const lines = this.rays.geometry.attributes.position, ends = this.hits.geometry.attributes.position;
    for (let ring = 0; ring < 2; ring++) {
      for (let j = 0; j < rays; j++) {
        const n = ring * rays + j, phi = (2 * Math.PI * j) / rays, c = Math.cos(phi), s = Math.sin(phi);
        const length = (run.series.lidar[2 * rays * record + n] / 255) * reach, ahead = ring ? -offset : offset;
        const start = [0, 0, 0], end = [0, 0, 0];
        ["x", "y", "z"].forEach((axis, i) => {
          start[i] = centre[axis] + ahead * forward[axis];
          end[i] = start[i] + length * (c * right[axis] + s * up[axis]);
        });
        lines.setXYZ(2 * n, ...start);
        lines.setXYZ(2 * n + 1, ...end);
        ends.setXYZ(n, ...end);
      }
    }
    lines.needsUpdate = ends.needsUpdate = true;
  }

  _pyramid(run, record, centre) {
    const { half_width, half_height, field_of_view } = run.camera, [forward, up, right] = this.axes;
    const length = 0.9 * run.series.radius[record];
    const wide = length * Math.tan(half_width * field_of_view), high = length * Math.tan(half_height * field_of_view);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
      centre.clone().addScaledVector(forward, length).addScaledVector(right, x * wide).addScaledVector(up, y * high));
    const place = this.cone.geometry.attributes.position;
    corners.forEach((corner, i) => {
      const after = corners[(i + 1) % 4];
      place.setXYZ(4 * i, centre.x, centre.y, centre.z);
      place.setXYZ(4 * i + 1, corner.x, corner.y, corner.z);
      place.setXYZ(4 * i + 2, corner.x, corner.y, corner.z);
      place.setXYZ(4 * i + 3, after.x, after.y, after.z);
    });
    place.needsUpdate = true;
  }

  _aim(run, record, centre, shown) {
    const { target_visible, target_position, memory_available, memory_direction, radius } = run.series;
    const seen = target_visible[record] > 0, point = vectorAt(target_position, record, new THREE.Vector3());
    this.target.visible = shown;
    this.sight.visible = shown && seen;
    this.memory.visible = shown && !seen && memory_available[record] > 0;
    this.target.position.copy(point);
    this.target.material.uniforms.colour.value.copy(seen ? this.seen : this.unseen);
    this.target.material.uniforms.ring.value = seen ? 0 : 1;
    this.sight.material.color.copy(this.seen);
    const place = this.sight.geometry.attributes.position;
    place.setXYZ(0, centre.x, centre.y, centre.z);
    place.setXYZ(1, point.x, point.y, point.z);
    place.needsUpdate = true;
    if (this.memory.visible) {
      const tip = vectorAt(memory_direction, record, point).multiplyScalar(1.4 * radius[record]).add(centre);
      this.memory.geometry.setPositions([centre.x, centre.y, centre.z, tip.x, tip.y, tip.z]);
    }
  }
}

/** All of the scene; draws itself when something changed, and rests otherwise. */
class View {
  constructor(data, canvas) {
    this.data = data;
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.tubes = data.tubes.map((tube) => new TubeView(tube));
    this.axes = data.tubes.map((tube) => ribbon(tube.axis, 1.5, 0.8));
    this.runs = data.runs.map((run) => new RunView(run));
    this.senses = new SensesView(Math.max(...data.runs.map((run) => run.lidar.rays)));
    this.scene.add(this.senses.group, new THREE.HemisphereLight(0xffffff, 0x888888, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(3, -4, 8);
    this.scene.add(sun);
    for (const part of [...this.tubes, ...this.runs]) this.scene.add(part.group);
    this.scene.add(...this.axes);
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.02, 1000);
    this.camera.up.copy(UP);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.redraw());
    this.layers = { path: true, axis: true, rays: true, cone: true, target: true };
    this.tubeMode = "glass";
    this.cameraMode = "overview";
    this.focus = data.runs[0];
    this.visible = new Set(data.runs);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Take colours from the style sheet, at the start and when the colour scheme changes. */
  paint(pathColours) {
    this.tubes.forEach((tube) => tube.paint(this.cameraMode === "aboard" ? 0.12 / this.radius : 0));
    for (const axis of this.axes) axis.material.color.set(cssColour("--axis"));
    this.senses.paint();
    for (const view of this.runs) {
      const colour = cssColour(this.runs.length > 1 ? `--run-${view.run.number % 8}` : "--drone");
      view.drone.material.color.set(colour);
      view.spot.material.uniforms.colour.value.set(colour);
      if (pathColours) view.colour(pathColours(view.run));
    }
    this.redraw();
  }

  get radius() {
    return this.focus.series.radius[0];
  }

  /** Which run is looked at, and which are seen at all. */
  choose(focus, visible) {
    this.focus = focus;
    this.visible = visible;
    this.runs.forEach((view) => { view.group.visible = visible.has(view.run); });
    const seen = new Set([...visible].map((run) => run.tube));
    this.tubes.forEach((tube, i) => { tube.group.visible = seen.has(i); });
    this.axes.forEach((axis, i) => { axis.visible = this.layers.axis && seen.has(i); });
    this.redraw();
  }

  setLayer(name, shown) {
    this.layers[name] = shown;
    this.choose(this.focus, this.visible);
    this.place(this.time);
  }

  setTube(mode) {
    this.tubeMode = mode;
    this.tubes.forEach((tube) => tube.show(this.cameraMode === "aboard" && mode !== "off" ? "whole" : mode));
    this.redraw();
  }

  /** Look at the whole tube, follow the drone in focus, or look out of it. */
  setCamera(mode) {
    this.cameraMode = mode;
    const camera = this.camera, drone = this.runs[this.focus.number].drone;
    this.controls.enabled = mode !== "aboard";
    camera.fov = mode === "aboard" ? 80 : 50;
    camera.near = mode === "overview" ? 0.05 * this.radius : 0.02 * this.radius;
    if (mode === "overview") this._fit();
    else if (mode === "follow") {
      this.heading = this._yaw(recordAt(this.focus, this.time).record);
      const back = new THREE.Vector3(-0.86, -0.42, 0.40).multiplyScalar(FOLLOW_DISTANCE * this.radius);
      camera.position.copy(drone.position).add(back.applyAxisAngle(UP, this.heading));
      this.controls.target.copy(drone.position);
    }
    camera.updateProjectionMatrix();
    this.setTube(this.tubeMode);
    this.tubes.forEach((tube) => tube.paint(mode === "aboard" ? 0.12 / this.radius : 0));
    this.place(this.time);
    if (this.controls.enabled) this.controls.update();
  }

  /** Stand where the whole of the focus's tube is seen, from the side on which it looks longest. */
  _fit() {
    const { center, radius } = this.tubes[this.focus.tube].sphere, camera = this.camera;
    const points = this.data.tubes[this.focus.tube].axis;
    const along = new THREE.Vector3(points.at(-3) - points[0], points.at(-2) - points[1], 0);
    const side = along.lengthSq() > 1e-9 ? along.normalize().cross(UP) : new THREE.Vector3(0, -1, 0);
    const half = (camera.fov * Math.PI) / 360, narrow = Math.min(1, camera.aspect);
    const away = (0.86 * radius) / Math.tan(half) / Math.max(narrow, 0.55);
    camera.position.copy(center).addScaledVector(side, away * 0.85).addScaledVector(UP, away * 0.5);
    camera.far = 20 * radius + 10;
    this.controls.target.copy(center);
  }

  /** Heading of the axis in the horizontal plane at a record of the focus; the last one where it stands upright. */
  _yaw(record) {
    const t = this.focus.series.tangent, x = t[3 * record], y = t[3 * record + 1];
    return Math.hypot(x, y) > 0.25 ? Math.atan2(y, x) : (this.heading ?? 0);
  }

  /** Put every drone where it was at this time (s); the camera goes along where it follows. */
  place(time) {
    this.time = time;
    for (const view of this.runs) {
      const { record, part } = recordAt(view.run, time);
      view.place(record, part);
      view.path.visible &&= this.layers.path;
      view.ghost.visible = this.layers.path;
      view.drone.visible = view.spot.visible = !(this.cameraMode === "aboard" && view.run === this.focus);
    }
    const { record } = recordAt(this.focus, time), drone = this.runs[this.focus.number].drone;
    const aboard = this.cameraMode === "aboard";
    this.senses.update(this.focus, record, drone, aboard ? { ...this.layers, cone: false, rays: false } : this.layers);
    if (this.cameraMode === "follow") {
      const turned = this._yaw(record), offset = this.camera.position.clone().sub(this.controls.target);
      offset.applyAxisAngle(UP, turned - this.heading);
      this.heading = turned;
      this.controls.target.copy(drone.position);
      this.camera.position.copy(drone.position).add(offset);
      this.controls.update();
    } else if (aboard) {
      const forward = new THREE.Vector3(1, 0, 0).applyQuaternion(drone.quaternion);
      this.camera.position.copy(drone.position);
      this.camera.up.set(0, 0, 1).applyQuaternion(drone.quaternion);
      this.camera.lookAt(forward.add(drone.position));
    }
    if (!aboard) this.camera.up.copy(UP);
    this.redraw();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.redraw();
  }

  redraw() {
    this.asked ??= requestAnimationFrame(() => {
      this.asked = undefined;
      this.renderer.render(this.scene, this.camera);
    });
  }
}
