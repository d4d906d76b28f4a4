// What the viewer needs of three.js, and no more: bundled into three.min.js by `npm run build`.
export {
  BufferAttribute,
  BufferGeometry,
  CubeTexture,
  DataTexture,
  LineSegments,
  LinearFilter,
  LinearMipmapLinearFilter,
  Mesh,
  PerspectiveCamera,
  RGBAFormat,
  Scene,
  ShaderMaterial,
  Vector3,
  Matrix3,
  WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/addons/controls/OrbitControls.js';
