// The 3-D view: tubes, paths, drones, and what the drone in focus senses.

const UP = new THREE.Vector3(0, 0, 1);
const LAYERS = { path: "path", axis: "centreline", rays: "LiDAR", cone: "camera", target: "target" };
const FOLLOW_DISTANCE = 5; // over R
const REST = 350; // ms
const HAZE = 0.35; // an R of distance, on board
const FILLED = 0.84; // of the view, by the tube

/** Whether this browser draws in 3-D at all. */
function has3d() {
  return !!document.createElement("canvas").getContext("webgl2");
}

/** Whether a GPU draws; else the processor does, and smooth edges would cost most of its time. */
function drawnByGpu() {
  return !!document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
}

/** The horizontal direction across the main course of points (3 N). */
function broadside(points) {
  let [x, y, xx, yy, xy] = [0, 0, 0, 0, 0];
  const count = points.length / 3;
  for (let i = 0; i < points.length; i += 3) {
    x += points[i] / count;
    y += points[i + 1] / count;
  }
  for (let i = 0; i < points.length; i += 3) {
    const [a, b] = [points[i] - x, points[i + 1] - y];
    xx += a * a;
    yy += b * b;
    xy += a * b;
  }
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy);
  return new THREE.Vector3(Math.sin(angle), -Math.cos(angle), 0);
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
    this.drone = new THREE.Mesh(shape, new THREE.MeshLambertMaterial());
    this.spot = spots(1, 17, true);
    this.spot.material.depthTest = false; // where the drone is must be seen from everywhere
    this.spot.renderOrder = 30;
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
    this.ghost = still(this.run.series.position, 2, 0.6, colours);
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

/** All of the scene; draws itself when something changed, and rests otherwise. */
class View {
  constructor(data, canvas) {
    this.data = data;
    this.canvas = canvas;
    this.quick = drawnByGpu();
    this.renderer = new THREE.WebGLRenderer({
      canvas,
      antialias: this.quick,
      alpha: true,
      preserveDrawingBuffer: true, // a printer comes later than the frame
    });
    this.ratio = Math.min(window.devicePixelRatio, 2);
    this.scene = new THREE.Scene();
    this.tubes = data.tubes.map((tube) => new TubeView(tube));
    this.axes = data.tubes.map((tube) => still(tube.axis, 1.5, 0.8));
    this.runs = data.runs.map((run) => new RunView(run));
    const met = data.runs.filter((run) => run.ending?.wall);
    this.endings = met.map((run) => new EndingView(run, canvas.parentElement));
    this.senses = new SensesView(Math.max(...data.runs.map((run) => run.lidar.rays)));
    this.scene.add(this.senses.group, new THREE.HemisphereLight(0xffffff, 0x888888, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(3, -4, 8);
    this.scene.add(sun);
    for (const part of [...this.tubes, ...this.runs]) this.scene.add(part.group);
    this.scene.add(...this.axes, ...this.endings.map((ending) => ending.spot));
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.02, 1000);
    this.camera.up.copy(UP);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this._letScroll();
    this.controls.addEventListener("change", () => this.redraw());
    this.controls.addEventListener("start", () => (this.turned = true));
    this.layers = { path: true, axis: true, rays: true, cone: true, target: true };
    this.tubeMode = "glass";
    this.cameraMode = "overview";
    this.focus = data.runs[0];
    this.visible = new Set(data.runs);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Leave wheel and finger to the page until the view is meant: a click makes the wheel its own, until the mouse goes. */
  _letScroll() {
    const { canvas, controls } = this;
    controls.enableZoom = false;
    canvas.style.touchAction = "pan-y"; // one finger that goes up or down scrolls, across it turns the view
    canvas.addEventListener("pointerdown", ({ pointerType, isPrimary }) => {
      controls.enableZoom = true;
      const held = pointerType === "touch" && isPrimary ? controls.getPolarAngle() : null;
      controls.minPolarAngle = held ?? 0;
      controls.maxPolarAngle = held ?? Math.PI;
    });
    canvas.addEventListener("pointerleave", ({ pointerType }) => {
      if (pointerType === "mouse") controls.enableZoom = false;
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, () => {
        controls.minPolarAngle = 0;
        controls.maxPolarAngle = Math.PI;
      });
    }
  }

  /** Take colours from the style sheet, at the start and when the colour scheme changes. */
  paint(pathColours) {
    this.tubes.forEach((tube) => tube.paint(this.cameraMode === "aboard" ? HAZE / this.radius : 0));
    for (const axis of this.axes) axis.material.color.set(cssColour("--axis"));
    for (const part of [this.senses, ...this.endings]) part.paint();
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
    this.runs.forEach((view) => {
      view.group.visible = visible.has(view.run);
    });
    const seen = new Set([...visible].map((run) => run.tube));
    this.tubes.forEach((tube, i) => {
      tube.group.visible = seen.has(i);
    });
    this.axes.forEach((axis, i) => {
      axis.visible = this.layers.axis && seen.has(i);
    });
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
    this.turned = false;
    const camera = this.camera,
      drone = this.runs[this.focus.number].drone;
    this.controls.enabled = mode !== "aboard";
    camera.fov = mode === "aboard" ? 80 : 50;
    camera.near = mode === "overview" ? 0.05 * this.radius : 0.02 * this.radius;
    if (mode === "overview") this._fit();
    else if (mode === "follow") {
      this.heading = this._yaw(recordAt(this.focus, this.time).record);
      const back = new THREE.Vector3(-0.86, -0.42, 0.4).multiplyScalar(FOLLOW_DISTANCE * this.radius);
      camera.position.copy(drone.position).add(back.applyAxisAngle(UP, this.heading));
      this.controls.target.copy(drone.position);
    }
    camera.updateProjectionMatrix();
    this.setTube(this.tubeMode);
    this.tubes.forEach((tube) => tube.paint(mode === "aboard" ? HAZE / this.radius : 0));
    this.place(this.time);
    if (this.controls.enabled) this.controls.update();
  }

  /** Following near the end of a flight that met a wall, stand where course and wall are seen side on. */
  faceEnding() {
    const { wall, time } = this.focus.ending ?? {};
    if (!wall || this.cameraMode !== "follow" || Math.abs(this.time - time) > 3) return;
    const { tangent, position } = this.focus.series,
      { record } = recordAt(this.focus, time);
    const along = vectorAt(tangent, record, new THREE.Vector3()),
      place = vectorAt(position, record, new THREE.Vector3());
    const side = new THREE.Vector3().fromArray(wall).sub(place).cross(along);
    if (side.length() < 1e-6) return;
    side.normalize().multiplyScalar(side.z < 0 ? -1 : 1).addScaledVector(along, -0.3).normalize();
    this.camera.position.copy(this.controls.target).addScaledVector(side, FOLLOW_DISTANCE * this.radius);
    this.controls.update();
  }

  /** Stand where the whole tube of the focus fills the view, on the side from which the way looks longest. */
  _fit() {
    const { camera } = this,
      { vertices, axis } = this.data.tubes[this.focus.tube];
    const { center, radius } = this.tubes[this.focus.tube].sphere,
      target = center.clone();
    const back = broadside(axis).multiplyScalar(0.85).addScaledVector(UP, 0.5).normalize();
    const tall = Math.tan((camera.fov * Math.PI) / 360),
      wide = tall * camera.aspect;
    const place = new THREE.Vector3(),
      every = 3 * Math.ceil(vertices.length / 30000);
    let away = radius / Math.min(tall, wide);
    for (let round = 0; round < 4; round++) {
      camera.position.copy(target).addScaledVector(back, away);
      camera.lookAt(target);
      camera.updateMatrixWorld();
      const low = new THREE.Vector2(Infinity, Infinity),
        high = new THREE.Vector2(-Infinity, -Infinity);
      for (let i = 0; i < vertices.length; i += every) {
        place.fromArray(vertices, i).applyMatrix4(camera.matrixWorldInverse);
        const at = new THREE.Vector2(-place.x / place.z / wide, -place.y / place.z / tall);
        low.min(at);
        high.max(at);
      }
      const middle = low
          .clone()
          .add(high)
          .multiplyScalar(0.5 * away),
        size = high.sub(low);
      const [x, y] = [new THREE.Vector3(), new THREE.Vector3()];
      camera.matrixWorld.extractBasis(x, y, place);
      target.addScaledVector(x, middle.x * wide).addScaledVector(y, middle.y * tall);
      away *= Math.max(size.x, size.y) / (2 * FILLED);
    }
    camera.position.copy(target).addScaledVector(back, away);
    camera.far = 20 * radius + 10;
    this.controls.target.copy(target);
  }

  /** Heading of the axis in the horizontal plane at a record of the focus; the last one where it stands upright. */
  _yaw(record) {
    const t = this.focus.series.tangent,
      x = t[3 * record],
      y = t[3 * record + 1];
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
      view.drone.visible = !(this.cameraMode === "aboard" && view.run === this.focus);
    }
    const { record } = recordAt(this.focus, time),
      drone = this.runs[this.focus.number].drone;
    const aboard = this.cameraMode === "aboard";
    this.senses.update(this.focus, record, drone, aboard ? { ...this.layers, cone: false, rays: false } : this.layers);
    if (this.cameraMode === "follow") {
      const turned = this._yaw(record),
        offset = this.camera.position.clone().sub(this.controls.target);
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
    if (!width || !height || (width === this.width && height === this.height)) return;
    [this.width, this.height] = [width, height];
    this._size(this.ratio);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.cameraMode === "overview" && !this.turned && this.time !== undefined) this.setCamera("overview");
    this.redraw();
  }

  _size(ratio) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(this.width, this.height, false);
  }

  /** Draw with the next frame. Without a GPU edges are smoothed only once nothing has moved for a while. */
  redraw() {
    this.asked ??= requestAnimationFrame(() => {
      this.asked = undefined;
      if (this.smooth) this._size(this.ratio);
      this.smooth = false;
      for (const view of this.runs) {
        // near by, the drone needs no ring to be found
        view.spot.visible =
          view.drone.visible &&
          this.camera.position.distanceTo(view.drone.position) > 2 * FOLLOW_DISTANCE * this.radius;
      }
      this.camera.updateMatrixWorld();
      for (const ending of this.endings)
        ending.pin(this.camera, this.width, this.height, ending.run === this.focus && this.layers.path);
      this.renderer.render(this.scene, this.camera);
      clearTimeout(this.resting);
      if (!this.quick) this.resting = setTimeout(() => this._smooth(), REST);
    });
  }

  _smooth() {
    this.smooth = true;
    this._size(2 * this.ratio);
    this.renderer.render(this.scene, this.camera);
  }
}
