// The stage: renderer, camera, light, and the room as Gaussian splats or, where drawing is done in software, as a mesh.

import * as THREE from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { SparkRenderer, SplatEdit, SplatEditRgbaBlendMode, SplatEditSdf, SplatEditSdfType, SplatFileType, SplatMesh } from '@sparkjsdev/spark';

const HEADROOM_M = 1.9; // what hangs higher above the floor is cut away, so that one can look in
const SOFTWARE_PIXELS = 0.75; // drawn per pixel of the screen, where a processor has to draw them
const WALL_M = 0.35; // a wall's thickness, with what leans on it

export const parseModel = (bytes) => new Promise((done, fail) => {
  new GLTFLoader().parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength), '', done, fail);
});

export class Room {
  constructor(canvas, contract) {
    this.canvas = canvas;
    this.contract = contract;
    this.software = drawsInSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.software, powerPreference: 'high-performance' });
    this.renderer.setClearColor(0xf5f2ec);
    this.renderer.localClippingEnabled = true;
    this.renderer.setPixelRatio(this.software ? SOFTWARE_PIXELS : Math.min(2, devicePixelRatio));
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xd9cdbd, 2.4));
    const sun = new THREE.DirectionalLight(0xfff4e2, 1.3);
    sun.position.set(1, 3, 2);
    this.scene.add(sun);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    this.orbit = new OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, { enableDamping: true, dampingFactor: 0.08, maxPolarAngle: 1.5, minDistance: 0.6, maxDistance: 14 });
    this.ray = new THREE.Raycaster();
    this.frameRoom();
    addEventListener('resize', () => this.resize());
    this.resize();
  }

  frameRoom() {
    const [low, high] = this.contract.scene.bounds_m;
    const span = Math.max(high[0] - low[0], high[2] - low[2]);
    const middle = [(low[0] + high[0]) / 2, this.contract.scene.floor_m + 0.25, (low[2] + high[2]) / 2];
    const narrow = innerWidth < 720 ? 1.75 : 1;
    this.orbit.target.set(...middle);
    this.camera.position.set(middle[0] + 0.62 * span * narrow, middle[1] + 0.98 * span * narrow, middle[2] + 0.86 * span * narrow);
    this.orbit.update();
  }

  async addMesh(bytes) {
    const model = await parseModel(bytes);
    const above = new THREE.Plane(new THREE.Vector3(0, -1, 0), this.contract.scene.floor_m + HEADROOM_M);
    model.scene.traverse((node) => {
      if (!node.isMesh) return;
      node.material = new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.FrontSide, clippingPlanes: [above] });
      this.mesh = node;
    });
    this.scene.add(model.scene);
  }

  async addSplats(bytes) {
    this.scene.add(new SparkRenderer({ renderer: this.renderer }));
    const splats = new SplatMesh({ fileBytes: bytes, fileType: SplatFileType.SPLAT, editable: true });
    this.shell = new SplatEditSdf({ type: SplatEditSdfType.BOX, opacity: 0, invert: true });
    const edit = new SplatEdit({ rgbaBlendMode: SplatEditRgbaBlendMode.MULTIPLY, sdfs: [this.shell] });
    splats.add(edit, this.shell);
    this.scene.add(splats);
    await splats.initialized;
    this.splats = splats;
    if (this.mesh) this.mesh.visible = false;
  }

  // Splats have no back: hide the walls between the camera and the room, and what hangs high.
  openShell() {
    const [low, high] = this.contract.scene.bounds_m.map((corner) => [...corner]);
    high[1] = this.contract.scene.floor_m + HEADROOM_M;
    low[1] -= 1;
    for (const [axis, name] of [[0, 'x'], [2, 'z']]) {
      const outside = this.camera.position[name];
      low[axis] += outside < low[axis] ? WALL_M : -1;
      high[axis] -= outside > high[axis] ? WALL_M : -1;
    }
    const key = [...low, ...high].join();
    if (key === this.shellKey) return;
    this.shellKey = key;
    this.shell.position.set(...low.map((value, axis) => (value + high[axis]) / 2));
    this.shell.scale.set(...low.map((value, axis) => (high[axis] - value) / 2));
  }

  // Drift gently with what matters, so that it stays in view.
  attend(point, seconds) {
    const { target } = this.orbit;
    const [dx, dz] = [point[0] - target.x, point[2] - target.z];
    const distance = Math.hypot(dx, dz);
    const slack = 0.9;
    if (distance < slack) return;
    const share = ((distance - slack) / distance) * Math.min(1, 0.5 * seconds);
    for (const spot of [target, this.camera.position]) {
      spot.x += dx * share;
      spot.z += dz * share;
    }
  }

  // A picture of the room from above, for the map.
  picture(size) {
    const [low, high] = this.contract.scene.bounds_m;
    const half = Math.max(high[0] - low[0], high[2] - low[2]) / 2;
    const eye = new THREE.OrthographicCamera(-half, half, half, -half, 0.01, 20);
    eye.position.set((low[0] + high[0]) / 2, high[1] + 1, (low[2] + high[2]) / 2);
    eye.up.set(0, 0, -1);
    eye.lookAt(eye.position.x, 0, eye.position.z);
    const target = new THREE.WebGLRenderTarget(size, size, { colorSpace: THREE.SRGBColorSpace });
    const hidden = this.scene.children.filter((child) => child.visible && !child.isLight && !child.getObjectById(this.mesh.id));
    const shown = this.mesh.visible;
    hidden.forEach((child) => { child.visible = false; });
    this.mesh.visible = true;
    this.renderer.setRenderTarget(target);
    this.renderer.render(this.scene, eye);
    const pixels = new Uint8Array(size * size * 4);
    this.renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
    this.renderer.setRenderTarget(null);
    target.dispose();
    hidden.forEach((child) => { child.visible = true; });
    this.mesh.visible = shown;
    return { pixels, center: [eye.position.x, eye.position.z], half };
  }

  resize() {
    const [width, height] = [innerWidth, innerHeight];
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // Leave the panel's side free: look a little to the right of the middle.
    const shift = width > 900 ? 120 : 0;
    this.camera.setViewOffset(width, height, shift, 0, width, height);
    this.camera.updateProjectionMatrix();
  }

  aim(event) {
    const pointer = new THREE.Vector2((event.clientX / innerWidth) * 2 - 1, 1 - (event.clientY / innerHeight) * 2);
    this.ray.setFromCamera(pointer, this.camera);
    return this.ray;
  }

  // Where the pointer meets the floor, [x, z], or null outside the room.
  floorPoint(event) {
    const plane = new THREE.Plane(new THREE.Vector3(0, 1, 0), -this.contract.scene.floor_m);
    const point = this.aim(event).ray.intersectPlane(plane, new THREE.Vector3());
    const [low, high] = this.contract.scene.bounds_m;
    const inside = point && point.x > low[0] && point.x < high[0] && point.z > low[2] && point.z < high[2];
    return inside ? [point.x, point.z] : null;
  }

  // The compass direction of the view on the floor, radians from +z towards +x.
  heading() {
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    return Math.atan2(forward.x, forward.z);
  }

  render() {
    if (this.splats) this.openShell();
    this.orbit.update();
    this.renderer.render(this.scene, this.camera);
  }
}

function drawsInSoftware() {
  const gl = document.createElement('canvas').getContext('webgl2');
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : '';
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
