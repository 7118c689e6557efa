export {
  AmbientLight, BackSide, BufferAttribute, BufferGeometry, Color, ConeGeometry, DirectionalLight, DoubleSide, DynamicDrawUsage,
  FrontSide, Group, HemisphereLight, LineBasicMaterial, LineSegments, LineLoop, Line, Matrix4, Mesh,
  MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Points, PointsMaterial, Quaternion, Scene,
  ShaderMaterial, SphereGeometry, Sphere, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
export { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
export { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
