// What the drone in focus senses, as recorded.

/** What the drone in focus senses: LiDAR, the camera's pyramid, target and memory. */
class SensesView {
  constructor(rays) {
    this.rays = segments(2 * rays, 0.5);
    this.hits = spots(2 * rays, 4);
    this.cone = segments(8, 0.9);
    const sides = new THREE.BufferGeometry();
    sides.setAttribute("position", new THREE.BufferAttribute(new Float32Array(15), 3)); // the tip, then the corners
    sides.setIndex([0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1]);
    this.sides = new THREE.Mesh(
      sides,
      new THREE.MeshBasicMaterial({
        transparent: true,
        opacity: 0.1,
        depthWrite: false,
        side: THREE.DoubleSide,
      }),
    );
    this.sides.frustumCulled = false;
    this.cone.add(this.sides);
    this.sight = segments(1, 0.9);
    this.target = spots(1, 11);
    this.memory = ribbon(new Float32Array(6), 4, 1);
    this.group = new THREE.Group();
    this.group.add(this.rays, this.hits, this.cone, this.sight, this.target, this.memory);
    this.axes = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
  }

  paint() {
    const set = (object, name) =>
      (object.material.uniforms?.colour?.value ?? object.material.color).set(cssColour(name));
    set(this.rays, "--ray");
    set(this.hits, "--ray");
    set(this.cone, "--cone");
    set(this.sides, "--cone");
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
    const { rays, offset, reach } = run.lidar,
      [forward, up, right] = this.axes;
    const lines = this.rays.geometry.attributes.position,
      ends = this.hits.geometry.attributes.position;
    for (let ring = 0; ring < 2; ring++) {
      for (let j = 0; j < rays; j++) {
        const n = ring * rays + j,
          phi = (2 * Math.PI * j) / rays,
          c = Math.cos(phi),
          s = Math.sin(phi);
        const length = (run.series.lidar[2 * rays * record + n] / 255) * reach,
          ahead = ring ? -offset : offset;
        const start = [0, 0, 0],
          end = [0, 0, 0];
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
    const { half_width, half_height, field_of_view } = run.camera,
      [forward, up, right] = this.axes;
    const length = 0.9 * run.series.radius[record];
    const wide = length * Math.tan(half_width * field_of_view),
      high = length * Math.tan(half_height * field_of_view);
    const corners = [
      [-1, -1],
      [1, -1],
      [1, 1],
      [-1, 1],
    ].map(([x, y]) =>
      centre
        .clone()
        .addScaledVector(forward, length)
        .addScaledVector(right, x * wide)
        .addScaledVector(up, y * high),
    );
    const place = this.cone.geometry.attributes.position,
      sides = this.sides.geometry.attributes.position;
    sides.setXYZ(0, centre.x, centre.y, centre.z);
    corners.forEach((corner, i) => {
      sides.setXYZ(i + 1, corner.x, corner.y, corner.z);
      const after = corners[(i + 1) % 4];
      place.setXYZ(4 * i, centre.x, centre.y, centre.z);
      place.setXYZ(4 * i + 1, corner.x, corner.y, corner.z);
      place.setXYZ(4 * i + 2, corner.x, corner.y, corner.z);
      place.setXYZ(4 * i + 3, after.x, after.y, after.z);
    });
    place.needsUpdate = sides.needsUpdate = true;
  }

  _aim(run, record, centre, shown) {
    const { target_visible, target_position, memory_available, memory_direction, radius } = run.series;
    const seen = target_visible[record] > 0,
      point = vectorAt(target_position, record, new THREE.Vector3());
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
      const tip = vectorAt(memory_direction, record, point)
        .multiplyScalar(1.4 * radius[record])
        .add(centre);
      this.memory.geometry.setPositions([centre.x, centre.y, centre.z, tip.x, tip.y, tip.z]);
    }
  }
}
