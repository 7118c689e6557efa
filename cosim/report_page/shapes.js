// Points and lines of a width in pixels, as three.js objects.

const WIDE_POINTS = 3000;
const SPOT = `
uniform vec3 colour;
uniform float size, ring;
void main() {
  float r = length(gl_PointCoord - 0.5) * 2.0;
  float edge = 2.0 / size;
  float alpha = 1.0 - smoothstep(1.0 - edge, 1.0, r);
  if (ring > 0.5) alpha *= smoothstep(0.55 - edge, 0.55, r) + 1.0 - smoothstep(0.40 - edge, 0.40, r);
  if (alpha < 0.02) discard;
  gl_FragColor = vec4(colour, alpha);
  #include <colorspace_fragment>
}`;

/** Round points of a size in pixels, which no distance makes smaller. */
function spots(count, size, ring = false) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
  const material = new THREE.ShaderMaterial({
    uniforms: { colour: { value: new THREE.Color() }, size: { value: size }, ring: { value: ring ? 1 : 0 } },
    vertexShader: `uniform float size; void main() {
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); gl_PointSize = size; }`,
    fragmentShader: SPOT,
    transparent: true,
    depthWrite: false,
  });
  const points = new THREE.Points(geometry, material);
  points.frustumCulled = false;
  points.onBeforeRender = (renderer) => {
    material.uniforms.size.value = size * renderer.getPixelRatio();
    material.uniformsNeedUpdate = true;
  };
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
  const material = new THREE.LineMaterial({ linewidth: width, transparent: true, opacity, vertexColors: !!colours });
  const line = new THREE.LineSegments2(geometry, material);
  line.frustumCulled = false;
  line.renderOrder = 20; // over the glass
  return line;
}

/** A line that does not change: of a width where it is short, of one pixel where that would take long to draw. */
function still(points, width, opacity, colours = null) {
  if (points.length / 3 <= WIDE_POINTS) return ribbon(points, width, opacity, colours);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
  if (colours) geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  const line = new THREE.Line(
    geometry,
    new THREE.LineBasicMaterial({ transparent: true, opacity, vertexColors: !!colours }),
  );
  line.renderOrder = 20;
  return line;
}

function vectorAt(array, i, into) {
  return into.set(array[3 * i], array[3 * i + 1], array[3 * i + 2]);
}
