// The tube: glass whose edges are seen more than its faces, or cut open towards the viewer where it was flown.

const TUBE_VERTEX = `
attribute vec3 outward;
varying vec3 vNormal, vPlace, vOutward;
void main() {
  vNormal = normal;
  vOutward = outward;
  vec4 place = modelMatrix * vec4(position, 1.0);
  vPlace = place.xyz;
  gl_Position = projectionMatrix * viewMatrix * place;
}`;

const TUBE_COMMON = `
uniform vec3 ink, ground;
uniform float strength, fog;
varying vec3 vNormal, vPlace, vOutward;
float facing() {
  return abs(dot(normalize(vNormal), normalize(cameraPosition - vPlace)));
}
// Whether the wall stands between the viewer and the axis, or was not flown.
bool closed() {
  return dot(vOutward, vOutward) < 0.1;
}
bool near() {
  return dot(vOutward, normalize(cameraPosition - vPlace)) > 0.05;
}`;

const GLASS_FRAGMENT = `${TUBE_COMMON}
void main() {
  float rim = 1.0 - facing();
  gl_FragColor = vec4(ink, strength * (0.07 + 0.60 * rim * rim * rim));
  #include <colorspace_fragment>
}`;

const SHELL_FRAGMENT = `${TUBE_COMMON}
uniform float cut;
void main() {
  if (cut > 0.5 && (closed() || near())) discard;
  float light = mix(0.30, 1.0, facing()) * exp(-fog * distance(cameraPosition, vPlace));
  gl_FragColor = vec4(mix(ground, ink, 0.18 + 0.62 * light), 1.0);
  #include <colorspace_fragment>
}`;

/** The tube as two meshes of one geometry; `show` takes "glass", "cut", "whole" or "off". */
class TubeView {
  constructor(tube) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(tube.vertices, 3));
    geometry.setAttribute("outward", new THREE.BufferAttribute(tube.outward, 3, true));
    geometry.setIndex(new THREE.BufferAttribute(tube.faces, 1));
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    this.sphere = geometry.boundingSphere;
    this.uniforms = {
      ink: { value: new THREE.Color() },
      ground: { value: new THREE.Color() },
      strength: { value: 1 },
      fog: { value: 0 },
      cut: { value: 0 },
    };
    const shared = { uniforms: this.uniforms, vertexShader: TUBE_VERTEX, side: THREE.DoubleSide };
    this.glass = new THREE.Mesh(
      geometry,
      new THREE.ShaderMaterial({
        ...shared,
        fragmentShader: GLASS_FRAGMENT,
        transparent: true,
        depthWrite: false,
        forceSinglePass: true,
      }),
    );
    this.shell = new THREE.Mesh(
      geometry,
      new THREE.ShaderMaterial({
        ...shared,
        fragmentShader: SHELL_FRAGMENT,
        polygonOffset: true,
        polygonOffsetFactor: 1,
        polygonOffsetUnits: 1,
      }),
    );
    this.glass.renderOrder = 10;
    this.group = new THREE.Group();
    this.group.add(this.shell, this.glass);
    this.show("glass");
  }

  show(how) {
    this.glass.visible = how === "glass" || how === "cut";
    this.shell.visible = how === "cut" || how === "whole";
    this.uniforms.strength.value = how === "cut" ? 0.35 : 1;
    this.uniforms.cut.value = how === "cut" ? 1 : 0;
  }

  paint(fog) {
    this.uniforms.ink.value.set(cssColour("--tube"));
    this.uniforms.ground.value.set(cssColour("--ground"));
    this.uniforms.fog.value = fog;
  }
}
