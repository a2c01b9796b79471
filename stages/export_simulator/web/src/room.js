// The stage: renderer, camera, light, and the room as Gaussian splats or, where drawing is done in software,
// as a mesh.

import * as THREE from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import {
  SparkRenderer,
  SplatEdit,
  SplatEditRgbaBlendMode,
  SplatEditSdf,
  SplatEditSdfType,
  SplatFileType,
  SplatMesh,
} from '@sparkjsdev/spark';
import { BACKDROP_LAYER, Backdrop } from './backdrop.js';
import { Cutaway } from './cutaway.js';
import { Steadiness } from './steadiness.js';

const HEADROOM_M = 1.9; // what hangs higher above the floor is cut away, so that one can look in
// drawn per pixel of the screen, most and least; wanted ms a frame, of which 1.15 times are tolerated: 19 a second
const PIXELS = { software: [0.75, 0.3, 46], graphics: [2, 0.6, 28] };
const WALL_M = 0.35; // a wall's thickness, with what leans on it
const FOG_M = 0.5; // Gaussians nearer to the eye are hidden
const FURTHEST_M = 14; // how far away the view may go
const FURTHEST = 4; // and in widths of the room: from there an upright phone shows it from wall to wall
const CLOSE_M = 1.7; // how far away the view stays that follows the animal
const CLOSER = 0.88; // the first view on a screen that is wide, in widths of the room
const TOWARDS_ANIMAL = 0.4; // how far from the room's middle to the animal that view looks
const RAISED_M = 0.12; // what is hit higher above the floor is furniture
const AZIMUTHS = 16; // directions tried from which the animal is to be seen closely
const CORNERS = [
  [1, 1],
  [-1, 1],
  [1, -1],
  [-1, -1],
]; // towards +x and +z, from which the room is looked into

export const parseModel = (bytes) =>
  new Promise((done, fail) => {
    new GLTFLoader().parse(
      bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength),
      '',
      done,
      fail,
    );
  });

export class Room {
  constructor(canvas, contract) {
    this.canvas = canvas;
    this.contract = contract;
    this.software = drawsInSoftware();
    this.renderer = new THREE.WebGLRenderer({
      canvas,
      antialias: !this.software,
      powerPreference: 'high-performance',
    });
    this.renderer.setClearColor(paperColor());
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
      this.renderer.setClearColor(paperColor());
      this.redraw();
    });
    this.renderer.localClippingEnabled = true;
    const [, least, wanted] = this.pixels;
    this.steadiness = new Steadiness(this.mostPixels, least, wanted, (ratio) =>
      this.renderer.setPixelRatio(ratio),
    );
    this.renderer.setPixelRatio(this.steadiness.ratio);
    this.scene = new THREE.Scene();
    if (this.software) this.backdrop = new Backdrop(this.renderer);
    document.body.classList.toggle('software', this.software);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xd9cdbd, 2.4));
    const sun = new THREE.DirectionalLight(0xfff4e2, 1.3);
    sun.position.set(1, 3, 2);
    this.scene.add(sun);
    const furthest = Math.max(FURTHEST_M, FURTHEST * this.span);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 5 * furthest);
    this.orbit = new OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, {
      enableDamping: true,
      dampingFactor: 0.08,
      maxPolarAngle: 1.5,
      minDistance: 0.6,
      maxDistance: furthest,
    });
    this.ray = new THREE.Raycaster();
    this.cutaway = new Cutaway(contract.scene.floor_m);
    this.frameRoom();
    addEventListener('resize', () => this.resize());
    this.resize();
  }

  // Draw the still of the room anew.
  redraw() {
    if (this.backdrop) this.backdrop.key = '';
  }

  get pixels() {
    return PIXELS[this.software ? 'software' : 'graphics'];
  }

  // Drawn per pixel at most, on the screen where the window is now.
  get mostPixels() {
    const [most] = this.pixels;
    return this.software ? most : Math.min(most, devicePixelRatio);
  }

  // The longer side of the room, meters.
  get span() {
    const [low, high] = this.contract.scene.bounds_m;
    return Math.max(high[0] - low[0], high[2] - low[2]);
  }

  // Look into the room from the corner that shows the animal, if one does.
  frameRoom(animal) {
    const [low, high] = this.contract.scene.bounds_m;
    const middle = new THREE.Vector3(
      (low[0] + high[0]) / 2,
      this.contract.scene.floor_m + 0.25,
      (low[2] + high[2]) / 2,
    );
    const narrow = innerWidth < 720;
    if (animal && !narrow) middle.lerp(new THREE.Vector3(animal[0], middle.y, animal[2]), TOWARDS_ANIMAL);
    const away = this.span * (narrow ? 1.75 : CLOSER);
    const from = ([x, z]) =>
      middle.clone().add(new THREE.Vector3(0.62 * x, 0.98, 0.86 * z).multiplyScalar(away));
    if (animal) this.corner = CORNERS.find((corner) => this.sees(from(corner), new THREE.Vector3(...animal)));
    this.orbit.target.copy(middle);
    this.camera.position.copy(from(this.corner ?? CORNERS[0]));
    this.orbit.update();
  }

  // Whether nothing that is drawn of the room's mesh stands between.
  sees(eye, point) {
    const ray = new THREE.Raycaster(eye, point.clone().sub(eye).normalize(), 0, eye.distanceTo(point) - 0.1);
    ray.layers.enableAll();
    this.mesh.updateWorldMatrix(true, false);
    return ray
      .intersectObject(this.mesh)
      .every((hit) => hit.point.y > this.contract.scene.floor_m + HEADROOM_M);
  }

  async addMesh(bytes) {
    const model = await parseModel(bytes);
    const above = new THREE.Plane(new THREE.Vector3(0, -1, 0), this.contract.scene.floor_m + HEADROOM_M);
    model.scene.traverse((node) => {
      if (!node.isMesh) return;
      node.material = new THREE.MeshBasicMaterial({
        vertexColors: true,
        side: THREE.FrontSide,
        clippingPlanes: [above],
      });
      this.cutaway.patch(node.material);
      this.mesh = node;
      if (this.backdrop) node.layers.set(BACKDROP_LAYER);
    });
    this.scene.add(model.scene);
  }

  async addSplats(bytes) {
    const splats = new SplatMesh({ fileBytes: bytes, fileType: SplatFileType.SPLAT, editable: true });
    this.shell = new SplatEditSdf({ type: SplatEditSdfType.BOX, opacity: 0, invert: true });
    const edit = new SplatEdit({ rgbaBlendMode: SplatEditRgbaBlendMode.MULTIPLY, sdfs: [this.shell] });
    // What floats right before the eye is fog, whatever it is made of.
    this.near = new SplatEditSdf({ type: SplatEditSdfType.SPHERE, opacity: 0, radius: FOG_M });
    const clear = new SplatEdit({
      rgbaBlendMode: SplatEditRgbaBlendMode.MULTIPLY,
      softEdge: 0.1,
      sdfs: [this.near],
    });
    splats.add(edit, this.shell, clear, this.near);
    this.cutaway.edit(splats);
    await splats.initialized;
    this.scene.add(new SparkRenderer({ renderer: this.renderer }), splats);
    this.splats = splats;
    // The mesh goes on hiding what is behind it, unseen: splats leave no depth.
    Object.assign(this.mesh.material, {
      colorWrite: false,
      transparent: true,
      polygonOffset: true,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 4,
    });
    this.mesh.renderOrder = 0.5;
  }

  // Splats have no back: hide the walls between the camera and the room, and what hangs high.
  openShell(eye) {
    const [low, high] = this.contract.scene.bounds_m.map((corner) => [...corner]);
    high[1] = this.contract.scene.floor_m + HEADROOM_M;
    low[1] -= 1;
    for (const [axis, name] of [
      [0, 'x'],
      [2, 'z'],
    ]) {
      const outside = eye[name];
      low[axis] += outside < low[axis] ? WALL_M : -1;
      high[axis] -= outside > high[axis] ? WALL_M : -1;
    }
    const key = [...low, ...high].join();
    if (key === this.shellKey) return;
    this.shellKey = key;
    this.shell.position.set(...low.map((value, axis) => (value + high[axis]) / 2));
    this.shell.scale.set(...low.map((value, axis) => (high[axis] - value) / 2));
  }

  // Look at the room, follow the animal closely, or stand in the person's place.
  look(view, eye, animal) {
    this.view = view;
    this.orbit.minDistance = view === 'room' ? 0.6 : 0.35;
    if (view === 'room') return this.frameRoom();
    this.orbit.target.set(...animal);
    if (view === 'you') this.camera.position.set(...eye);
    else {
      this.camera.position.copy(this.closeTo(animal));
    }
    this.orbit.update();
  }

  // Where an eye sees the animal closely, as near as can be to where it is now.
  closeTo(animal) {
    const away = this.camera.position.clone().sub(this.orbit.target).setY(0).normalize();
    const from = (turns) =>
      away
        .clone()
        .applyAxisAngle(this.camera.up, turns * 2 * Math.PI)
        .multiplyScalar(CLOSE_M)
        .setY(0.55 * CLOSE_M)
        .add(this.orbit.target);
    const tried = Array.from({ length: AZIMUTHS }, (_, i) =>
      from(((i % 2 ? 1 : -1) * Math.ceil(i / 2)) / AZIMUTHS),
    );
    const [low, high] = this.contract.scene.bounds_m;
    const inside = (eye) => eye.x > low[0] && eye.x < high[0] && eye.z > low[2] && eye.z < high[2];
    const open = tried.filter((eye) => this.sees(eye, new THREE.Vector3(...animal)));
    return open.find(inside) ?? open[0] ?? tried[0];
  }

  // Turn about what is looked at (radians) or come closer (a factor).
  turn(angle, closer) {
    const offset = this.camera.position.clone().sub(this.orbit.target);
    offset.applyAxisAngle(this.camera.up, angle).multiplyScalar(closer);
    offset.setLength(Math.min(this.orbit.maxDistance, Math.max(this.orbit.minDistance, offset.length())));
    this.camera.position.copy(this.orbit.target).add(offset);
  }

  // Drift gently with what matters, so that it stays in view.
  attend(point, seconds, eye) {
    if (this.view === 'you') {
      this.camera.position.set(...eye);
      return this.orbit.target.set(...point);
    }
    // the whole room is in view, and a still view is cheap to draw
    if (this.backdrop && this.view !== 'animal') return;
    const { target } = this.orbit;
    const [dx, dz] = [point[0] - target.x, point[2] - target.z];
    const distance = Math.hypot(dx, dz);
    const slack = this.view === 'animal' ? 0.12 : 0.9;
    if (distance < slack) return;
    const share =
      ((distance - slack) / distance) * Math.min(1, (this.view === 'animal' ? 2.5 : 0.5) * seconds);
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
    eye.layers.enable(BACKDROP_LAYER);
    const target = new THREE.WebGLRenderTarget(size, size, { colorSpace: THREE.SRGBColorSpace });
    const hidden = this.scene.children.filter(
      (child) => child.visible && !child.isLight && !child.getObjectById(this.mesh.id),
    );
    const [shown, paper] = [this.mesh.visible, this.renderer.getClearColor(new THREE.Color())];
    this.renderer.setClearColor(paper, 0);
    hidden.forEach((child) => {
      child.visible = false;
    });
    this.mesh.visible = true;
    this.renderer.setRenderTarget(target);
    this.cutaway.without(() => this.renderer.render(this.scene, eye));
    const pixels = new Uint8Array(size * size * 4);
    this.renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
    this.renderer.setRenderTarget(null);
    this.renderer.setClearColor(paper, 1);
    target.dispose();
    hidden.forEach((child) => {
      child.visible = true;
    });
    this.mesh.visible = shown;
    return { pixels, center: [eye.position.x, eye.position.z], half };
  }

  resize() {
    if (this.renderer.xr.isPresenting) return; // a headset has a size of its own
    const [width, height] = [innerWidth, innerHeight];
    this.steadiness.most = this.mostPixels;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // Leave the panel's side free: look a little to the right of the middle.
    const shift = width > 900 && height > 620 ? 120 : 0;
    this.camera.setViewOffset(width, height, shift, 0, width, height);
    this.camera.updateProjectionMatrix();
  }

  aim(event) {
    const pointer = new THREE.Vector2(
      (event.clientX / innerWidth) * 2 - 1,
      1 - (event.clientY / innerHeight) * 2,
    );
    this.ray.setFromCamera(pointer, this.camera);
    return this.ray;
  }

  // Where the pointer meets the floor, [x, z], or null outside the room.
  floorPoint(event) {
    return this.floorAlong(this.aim(event));
  }

  // Where the pointer meets a level so far above the floor, [x, z]; null above the horizon.
  levelPoint(event, up) {
    const point = levelAlong(this.aim(event), this.contract.scene.floor_m + up);
    return point && [point.x, point.z];
  }

  floorAlong(caster) {
    const point = levelAlong(caster, this.contract.scene.floor_m);
    const [low, high] = this.contract.scene.bounds_m;
    const inside = point && point.x > low[0] && point.x < high[0] && point.z > low[2] && point.z < high[2];
    return inside ? [point.x, point.z] : null;
  }

  // What a click shows: {place: [x, z], up}, up being the height above the floor of the furniture that is
  // hit, or 0; null outside the room.
  surfacePoint(event) {
    return this.surfaceAlong(this.aim(event));
  }

  // The same for a ray of the scene.
  surfaceAlong(ray) {
    const floor = this.floorAlong(ray);
    if (!this.mesh) return floor && { place: floor, up: 0 };
    ray.layers.enableAll();
    this.mesh.updateWorldMatrix(true, false);
    const { floor_m: floorHeight } = this.contract.scene;
    const hit = ray
      .intersectObject(this.mesh)
      .find(({ point }) => point.y < floorHeight + HEADROOM_M && !this.cutaway.covers(point));
    if (!hit || hit.point.y < floorHeight + RAISED_M) return floor && { place: floor, up: 0 };
    return { place: [hit.point.x, hit.point.z], up: hit.point.y - floorHeight };
  }

  // The height of the mesh beneath a point, or null.
  surfaceBelow(point) {
    const ray = new THREE.Raycaster(new THREE.Vector3(...point), new THREE.Vector3(0, -1, 0));
    ray.layers.enableAll();
    return ray.intersectObject(this.mesh)[0]?.point.y ?? null;
  }

  // Cut away what hides the animal.
  reveal(animal) {
    if (this.renderer.xr.isPresenting) return;
    const point = new THREE.Vector3(...animal);
    this.cutaway.follow(
      this.camera.position,
      point,
      () => !this.sees(this.camera.position, point),
      Boolean(this.backdrop),
    );
  }

  // The compass direction of the view on the floor, radians from +z towards +x.
  heading() {
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    return Math.atan2(forward.x, forward.z);
  }

  render() {
    const eye = this.camera.getWorldPosition(new THREE.Vector3());
    if (this.splats) this.openShell(eye);
    if (this.near && this.near.position.distanceTo(eye) > 0.05) this.near.position.copy(eye);
    if (this.renderer.xr.isPresenting) return this.renderer.render(this.scene, this.camera);
    this.orbit.update();
    if (this.backdrop && !this.splats) this.backdrop.render(this.scene, this.camera, this.cutaway.key);
    else this.renderer.render(this.scene, this.camera);
  }
}

const levelAlong = ({ ray }, height) =>
  ray.intersectPlane(new THREE.Plane(new THREE.Vector3(0, 1, 0), -height), new THREE.Vector3());

const paperColor = () =>
  new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue('--paper').trim());

function drawsInSoftware() {
  const gl = document.createElement('canvas').getContext('webgl2');
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : '';
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
