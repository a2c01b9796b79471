// The room in a headset (WebXR), where the browser has one: the visitor stands where the person stands, at
// full size. What a hand points at and selects is a goal, a squeeze calls the animal, the left stick walks,
// the right one turns.

import * as THREE from 'three';
import { BACKDROP_LAYER } from './backdrop.js';
import { WALK_M_S } from './observer.js';

const TURN_RAD = Math.PI / 6;
const STICK = 0.5; // how far a stick is pushed that turns
const SLACK = 0.15; // and that walks
const BEAM_M = 4;

export class Headset {
  static async possible() {
    try {
      return Boolean(await navigator.xr?.isSessionSupported('immersive-vr'));
    } catch {
      return false; // forbidden by a page around this one
    }
  }

  // on: {aim(surface), call(), change(presenting)}.
  constructor(room, observer, floor, on) {
    Object.assign(this, { room, observer, floor, on, eye: observer.eye, presenting: false });
    this.rig = new THREE.Group();
    this.hands = [0, 1].map((index) => this.hand(room.renderer.xr.getController(index)));
    // after three.js has restored what it changed, the size of the canvas among it
    room.renderer.xr.addEventListener('sessionend', () => this.left());
  }

  hand(controller) {
    const beam = new THREE.BufferGeometry().setFromPoints([
      new THREE.Vector3(),
      new THREE.Vector3(0, 0, -BEAM_M),
    ]);
    controller.add(new THREE.Line(beam, new THREE.LineBasicMaterial({ color: 0x2f6f9f })));
    controller.addEventListener('select', () => {
      const surface = this.room.surfaceAlong(this.ray(controller));
      if (surface) this.on.aim(surface);
    });
    controller.addEventListener('squeeze', () => this.on.call());
    return controller;
  }

  ray(controller) {
    controller.updateWorldMatrix(true, false);
    const from = new THREE.Vector3().setFromMatrixPosition(controller.matrixWorld);
    return new THREE.Raycaster(from, new THREE.Vector3(0, 0, -1).transformDirection(controller.matrixWorld));
  }

  async start() {
    if (this.presenting) return this.session.end();
    const { renderer, scene, camera, cutaway } = this.room;
    this.session = await navigator.xr.requestSession('immersive-vr', { requiredFeatures: ['local-floor'] });
    this.before = { place: camera.position.clone(), turn: camera.quaternion.clone(), fov: camera.fov };
    this.rig.position.set(this.observer.place[0], this.floor, this.observer.place[1]);
    const { animal, place } = this.observer;
    this.rig.rotation.y = Math.atan2(place[0] - animal[0], place[1] - animal[2]); // -z is ahead
    camera.position.set(0, this.eye, 0); // until the head is tracked
    camera.quaternion.identity();
    camera.layers.enable(BACKDROP_LAYER);
    this.rig.add(camera, ...this.hands);
    scene.add(this.rig);
    cutaway.uniforms.cutRadius.value = 0;
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType('local-floor');
    try {
      await renderer.xr.setSession(this.session);
    } catch (error) {
      await this.session.end().catch(() => {}); // it may have ended by itself
      throw error;
    }
    this.presenting = true;
    this.tracked = false;
    this.on.change(true);
  }

  left() {
    const { renderer, scene, camera } = this.room;
    renderer.xr.enabled = this.presenting = false;
    scene.remove(this.rig);
    this.rig.remove(camera);
    camera.position.copy(this.before.place);
    camera.quaternion.copy(this.before.turn);
    camera.fov = this.before.fov;
    this.observer.eye = this.eye;
    renderer.setPixelRatio(this.room.steadiness.ratio);
    this.room.resize();
    this.on.change(false);
  }

  // Let seconds pass: walk and turn by the sticks, and stand where the head is. Returns whether the person
  // has moved.
  step(seconds) {
    const { camera } = this.room;
    const [right, back] = this.stick('left');
    const ahead = camera.getWorldDirection(new THREE.Vector3()).setY(0).normalize();
    const aside = new THREE.Vector3(-ahead.z, 0, ahead.x);
    const way = ahead.multiplyScalar(-back).addScaledVector(aside, right);
    this.rig.position.addScaledVector(way, WALK_M_S * seconds);
    this.rig.updateMatrixWorld(true);
    const head = this.head();
    const { observer } = this;
    if (!head) return false;
    if (!this.tracked) {
      this.tracked = true; // the room is brought to where the head is in its own
      this.shift(observer.place, head);
      return false;
    }
    this.turn(this.stick('right')[0], head);
    const before = [...observer.place];
    observer.target = null;
    observer.eye = Math.max(0.1, head.y - this.floor);
    observer.place = observer.apart([head.x, head.z]);
    observer.step(0, [0, 0], 0); // within the room
    // who walks against a wall, or the animal, stays before it
    this.shift(observer.place, head);
    return Math.hypot(observer.place[0] - before[0], observer.place[1] - before[1]) > 1e-4;
  }

  shift([x, z], from) {
    this.rig.position.x += x - from.x;
    this.rig.position.z += z - from.z;
  }

  // Where the head is, world meters; null until it is tracked.
  head() {
    const { xr } = this.room.renderer;
    const pose = xr.getFrame()?.getViewerPose(xr.getReferenceSpace());
    if (!pose) return null;
    const { x, y, z } = pose.transform.position;
    return this.rig.localToWorld(new THREE.Vector3(x, y, z));
  }

  // Turn by a step about the head, once for each push of the stick.
  turn(push, head) {
    const pushed = Math.abs(push) > STICK;
    if (pushed && !this.pushed) {
      const angle = -Math.sign(push) * TURN_RAD;
      this.rig.position.sub(head).applyAxisAngle(this.rig.up, angle).add(head);
      this.rig.rotation.y += angle;
    }
    this.pushed = pushed;
  }

  // How far the stick of a hand is pushed to the right and back, -1..1.
  stick(hand) {
    for (const { handedness, gamepad } of this.session.inputSources) {
      if (handedness !== hand || !gamepad) continue;
      const push = gamepad.axes.slice(-2); // a pad, if there is one, comes first
      if (Math.hypot(...push) > SLACK) return push;
    }
    return [0, 0];
  }
}
